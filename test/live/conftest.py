"""Fixtures of all live tests."""

from support.live_graph import graph as graph
