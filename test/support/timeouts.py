"""How long tests wait for what must come."""

# Generous: a test waits for what it wants, and fails only where that never comes. A machine that is
# busy is no reason; nor does it cost anything where all is well. Shorter than pytest's own timeout.
PATIENCE_S = 300.0
# How long a program may take from its start to its end.
PROGRAM_S = 800.0
