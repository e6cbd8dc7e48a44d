"""The page of the explorations that `compare_exploration` has run."""
