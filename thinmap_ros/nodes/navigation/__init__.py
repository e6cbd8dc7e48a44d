"""Parts of the navigator node."""
