"""Graphs of whole floors: time, size, completeness, and thinning against the Voronoi diagram."""
