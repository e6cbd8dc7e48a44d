"""Visualization: figures and rerun."""
