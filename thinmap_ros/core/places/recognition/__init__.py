"""Place recognition: whether two pieces of map show the same place."""
