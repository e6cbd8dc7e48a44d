"""Clocks of a node: jumps of its time, and time that does not jump."""
