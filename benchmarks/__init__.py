"""Benchmarks: what thinmap does against named peers in the same run, and against its own targets."""
