"""Foundation of all rooms: error state, enumerations, stamps; writes the augmented states and their covariance only."""
