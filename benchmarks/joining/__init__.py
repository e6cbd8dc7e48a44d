"""Joint maps of several robots: when they are joined, how well, and at which cost."""
