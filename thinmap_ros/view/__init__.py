"""What people look at: figures, and rerun."""
