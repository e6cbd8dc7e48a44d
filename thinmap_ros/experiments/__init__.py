"""The papers' experiments.

One module each, with a function `run` that returns tables, figures and comparisons.
"""
