"""Mutation tests: see scripts/mutants."""
