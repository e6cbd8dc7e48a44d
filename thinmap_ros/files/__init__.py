"""Files on disk, read within limits and written atomically."""
