"""What judges a run: errors, metrics, reports, and runs side by side."""
