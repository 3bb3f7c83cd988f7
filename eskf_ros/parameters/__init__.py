"""The parameters: names, units, defaults, ranges and what they mean. `tree.py` holds them all."""
