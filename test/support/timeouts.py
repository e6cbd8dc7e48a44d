"""Timeouts of tests."""

# Generous, so that a busy machine does not fail a test; a test that succeeds does not wait longer.
# Shorter than pytest's own timeout.
PATIENCE_S = 300.0
# Time limit of a program from its start to its end.
PROGRAM_S = 800.0
