"""Command line programs."""

import thinmap_ros.startup  # noqa: F401  before all other modules
