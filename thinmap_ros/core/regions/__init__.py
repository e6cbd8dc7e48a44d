"""Rooms, corridors and halls of a map, and the doors between them."""
