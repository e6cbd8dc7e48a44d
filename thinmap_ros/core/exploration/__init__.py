"""Where to look next, and when all is seen: end nodes and their position probability."""
