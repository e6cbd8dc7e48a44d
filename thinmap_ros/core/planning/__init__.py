"""Path planning on grid and graph, and path following."""
