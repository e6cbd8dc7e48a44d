"""Place recognition between pieces of maps, and joining them."""
