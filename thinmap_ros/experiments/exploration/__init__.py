"""The exploration paper's figures, and strategies compared."""
