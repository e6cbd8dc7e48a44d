"""What all live tests share."""

from support.live_graph import graph as graph
