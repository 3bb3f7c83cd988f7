"""Tight coupling: signals of an epoch; may reset the clock states and widen position and velocity."""
