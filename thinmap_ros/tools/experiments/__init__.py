"""The papers' experiments: one module each, with a function `run` that returns tables, figures and comparisons."""
