"""Benchmarks: what thinmap does against named peers in the same run, and against own targets."""

import thinmap_ros.startup  # noqa: F401  before NumPy, for which it sets the number of threads
