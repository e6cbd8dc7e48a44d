"""What the tests of documents share with the live ones."""

from support.live_graph import graph as graph
