"""Velocity commands as messages."""
