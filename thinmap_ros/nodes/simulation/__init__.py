"""Parts of the node sim."""
