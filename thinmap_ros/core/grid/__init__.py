"""Occupancy grids: where the cells are, what the laser says of them, and the one ray traversal."""
