"""The campaigns of faults: what is broken, how it is run, and how it is judged."""
