"""Cases that nobody thought of: see scripts/fuzz."""
