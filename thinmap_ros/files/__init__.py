"""What lies on a disk, read within limits and written whole or not at all."""
