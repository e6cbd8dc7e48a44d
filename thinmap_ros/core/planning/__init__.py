"""Ways through the known.

Along edges of the topological map, over the cells of the grid, and how to drive them.
"""
