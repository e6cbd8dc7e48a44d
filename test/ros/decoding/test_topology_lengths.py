"""Topological maps of other nodes: refused where a length is negative."""

import pytest
from geometry_msgs.msg import Point32

from thinmap_msgs.msg import TopologicalEdge, TopologicalMap, TopologicalNode
from thinmap_ros.core.errors import InputError
from thinmap_ros.ros.decoding.topology_reader import topology_from_msg


def graph() -> TopologicalMap:
    nodes = [TopologicalNode(id=i, kind=0, clearance_m=0.5) for i in (1, 2)]
    path = [Point32(x=0.0), Point32(x=1.0)]
    edge = TopologicalEdge(id=3, node_a=1, node_b=2, path=path, length_m=1.0, clearance_m=0.5)
    return TopologicalMap(nodes=nodes, edges=[edge])


def test_lengths_are_not_negative() -> None:
    assert len(topology_from_msg(graph()).edges) == 1
    message = graph()
    message.nodes[0].clearance_m = -0.5
    with pytest.raises(InputError, match=r'node 1: clearance: -0.5 m'):
        topology_from_msg(message)
    for name in ('length_m', 'clearance_m'):
        message = graph()
        setattr(message.edges[0], name, -0.5)
        with pytest.raises(InputError, match=r'edge 3: length, clearance: -0.5 m'):
            topology_from_msg(message)
