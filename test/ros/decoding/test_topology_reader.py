"""Topological maps from serialized messages, and from what is no such message."""

import numpy as np
import pytest
from geometry_msgs.msg import Point, Point32
from rclpy.serialization import serialize_message

from thinmap_msgs.msg import TopologicalEdge, TopologicalMap, TopologicalNode
from thinmap_ros.core.errors import InputError
from thinmap_ros.ros import messages
from thinmap_ros.ros.decoding.topology_reader import read_topology


def random_map(seed, frame='map'):
    rng = np.random.default_rng(seed)
    message = TopologicalMap()
    message.header = messages.header(frame, int(rng.integers(10**18)))
    count = int(rng.integers(0, 8))
    for number in range(1, count + 1):
        x, y = rng.uniform(-100.0, 100.0, 2).tolist()
        features = rng.integers(0, 99, int(rng.integers(0, 4))).tolist()
        message.nodes.append(
            TopologicalNode(
                id=number,
                kind=int(rng.integers(3)),
                position=Point(x=x, y=y),
                clearance_m=float(rng.random()),
                feature_ids=features,
            )
        )
    for number in range(count + 1, count + 1 + int(rng.integers(0, 9)) * (count > 0)):
        a, b = rng.integers(1, count + 1, 2).tolist()
        path = [Point32(x=float(x), y=float(y)) for x, y in rng.random((rng.integers(1, 9), 2))]
        message.edges.append(
            TopologicalEdge(id=number, node_a=a, node_b=b, length_m=1.5, clearance_m=0.5, path=path)
        )
    return message


@pytest.mark.parametrize('frame', ['', 'm', 'ma', 'map', 'robot/map'])
def test_all_fields_are_read(frame):
    for seed in range(60):
        message = random_map(seed, frame)
        found = read_topology(serialize_message(message))
        assert len(found.nodes) == len(message.nodes)
        assert len(found.edges) == len(message.edges)
        for node in message.nodes:
            read = found.nodes[node.id]
            assert (read.x, read.y, read.kind) == (node.position.x, node.position.y, node.kind)
            assert read.clearance_m == np.float32(node.clearance_m)
        for edge in message.edges:
            read = found.edges[edge.id]
            assert (read.a, read.b, read.length_m) == (edge.node_a, edge.node_b, edge.length_m)
            assert read.clearance_m == edge.clearance_m
            points = np.array([(p.x, p.y) for p in edge.path], dtype=np.float32)
            np.testing.assert_array_equal(read.path, points)


def test_truncated_and_altered_messages_are_refused_or_read_in_part_of_a_second():
    data = serialize_message(random_map(5))
    for end in range(len(data)):
        with pytest.raises(InputError):
            read_topology(data[:end])
    rng = np.random.default_rng(0)
    for _ in range(2000):
        altered = bytearray(data)
        altered[int(rng.integers(len(data)))] = int(rng.integers(256))
        try:
            read_topology(bytes(altered))
        except InputError as error:
            assert '\n' not in str(error)


def edge_between(a, b, path=((0.0, 0.0), (1.0, 0.0)), number=9):
    points = [Point32(x=x, y=y) for x, y in path]
    return TopologicalEdge(id=number, node_a=a, node_b=b, length_m=1.0, path=points)


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        (lambda m: m.edges.append(edge_between(1, 3)), 'nodes of this map'),
        (lambda m: m.edges.append(edge_between(1, 2, path=())), 'empty path'),
        (lambda m: m.edges.append(edge_between(1, 2, path=((np.nan, 0.0),))), 'from -'),
        (lambda m: m.edges.extend([edge_between(1, 2), edge_between(2, 1)]), 'an id for each'),
        (lambda m: m.edges.append(edge_between(1, 2, number=1)), 'that no node has'),
        (lambda m: setattr(m.nodes[0], 'kind', 7), 'kind 7'),
        (lambda m: setattr(m.nodes[0], 'id', 2), 'an id for each'),
        (lambda m: setattr(m.nodes[0].position, 'x', np.inf), 'from -'),
    ],
)
def test_maps_that_are_none_are_refused(change, reason):
    message = TopologicalMap(nodes=[TopologicalNode(id=1), TopologicalNode(id=2)])
    read_topology(serialize_message(message))
    change(message)
    with pytest.raises(InputError, match=reason):
        read_topology(serialize_message(message))
