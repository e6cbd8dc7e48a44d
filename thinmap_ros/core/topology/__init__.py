"""The thinning-based topological map: free space, skeleton, nodes and edges, local maps into the global one."""
