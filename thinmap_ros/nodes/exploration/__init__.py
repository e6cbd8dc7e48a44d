"""Parts of the node explorer."""
