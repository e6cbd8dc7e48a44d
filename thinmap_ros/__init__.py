"""thinmap: thinning-based topological mapping, exploration and SLAM for robots with one 2D laser scanner."""
