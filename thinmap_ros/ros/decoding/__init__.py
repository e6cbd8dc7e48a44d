"""What messages tell of their maps."""
