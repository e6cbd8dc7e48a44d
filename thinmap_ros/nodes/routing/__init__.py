"""The graph for route servers; a part of the node topology_builder."""
