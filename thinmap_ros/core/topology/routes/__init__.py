"""Route graphs: topological maps of saved maps, reduced to what a person would draw."""
