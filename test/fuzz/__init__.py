"""Fuzz tests: see scripts/fuzz."""
