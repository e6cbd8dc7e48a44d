"""kidnapped."""
