"""The figures of the paper on topological maps."""
