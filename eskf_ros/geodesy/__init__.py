"""The Earth: geodesy, gravity, magnetic field, rotations; shared by filter, node, replay and simulator."""
