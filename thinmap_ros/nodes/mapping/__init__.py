"""Parts of the grid mapper: its input and its output."""
