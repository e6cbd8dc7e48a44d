"""Robots that are switched on anywhere in a known map, by the hundred."""
