"""The thinning-based topological map.

Free space, skeleton, nodes and edges, local maps into the global one.
"""
