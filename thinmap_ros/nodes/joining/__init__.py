"""Parts of the node map_joiner."""
