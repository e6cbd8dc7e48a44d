"""Fixtures that the tests of documents share with the live tests."""

from support.live_graph import graph as graph
