"""Evaluation of runs: errors, metrics, reports and comparisons."""
