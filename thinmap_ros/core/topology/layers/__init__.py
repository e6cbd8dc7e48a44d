"""The layers from the grid to the edges of the map, each updated where its input changed."""
