"""What the parts take of time and memory, against named peers and own targets."""
