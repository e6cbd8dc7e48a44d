"""Changes of the code that a test should find: see scripts/mutants."""
