"""topological_map."""
