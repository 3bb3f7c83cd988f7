"""The parameters: names, units, defaults, ranges and descriptions. `tree.py` holds them all."""
