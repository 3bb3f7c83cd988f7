"""The smoother: the best trajectory afterwards, from measurements before and after each moment."""
