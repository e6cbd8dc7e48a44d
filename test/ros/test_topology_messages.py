"""Topological maps as messages: what is written is read, and what is no such map is refused."""

import re
import textwrap

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.msg import get_types_from_msg
from support.node_list import ROOT

from thinmap_msgs.msg import TopologicalMap as TopologicalMapMsg
from thinmap_ros import InputError, topology_from_msg
from thinmap_ros.core.topology.graph import (
    FIELDS,
    Edge,
    Node,
    NodeKind,
    TopologicalMap,
    flat_topology,
)
from thinmap_ros.files.package_data import message_definitions
from thinmap_ros.logs.bag_writer import BagWriter
from thinmap_ros.logs.readers.bag import Bag
from thinmap_ros.ros import messages

NAME = 'thinmap_msgs/msg/TopologicalMap'
DEFINITION = ROOT / 'thinmap_msgs' / 'msg' / 'TopologicalMap.msg'


def random_map(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 8))
    nodes = [
        Node(
            i, NodeKind(int(rng.integers(3))), *rng.uniform(-100.0, 100.0, 2).tolist(), rng.random()
        )
        for i in rng.permutation(np.arange(1, count + 1)).tolist()
    ]
    edges = [
        Edge(
            i,
            *rng.integers(1, count + 1, 2).tolist(),
            rng.random((rng.integers(1, 9), 2)),
            1.5,
            0.3,
        )
        for i in range(count + 1, count + 1 + int(rng.integers(0, 9)) * (count > 0))
    ]
    return TopologicalMap(nodes, edges)


def assert_read(found, expected):
    assert list(found.nodes) == list(expected.nodes)
    assert list(found.edges) == list(expected.edges)
    for node in expected.nodes.values():
        read = found.nodes[node.id]
        assert (read.x, read.y, read.kind) == (node.x, node.y, node.kind)
        assert read.clearance_m == np.float32(node.clearance_m)
    for edge in expected.edges.values():
        read = found.edges[edge.id]
        assert (read.a, read.b, read.length_m) == (edge.a, edge.b, edge.length_m)
        assert read.clearance_m == np.float32(edge.clearance_m)
        np.testing.assert_array_equal(read.path, edge.path.astype(np.float32))


def test_all_fields_are_read():
    for seed in range(60):
        written = random_map(seed)
        message = messages.topology_msg(written, 'map', 10**18 + seed, map_id=2**63)
        received = deserialize_message(serialize_message(message), TopologicalMapMsg)
        assert received == message and received.header.frame_id == 'map'
        assert received.map_id == 2**63
        assert_read(topology_from_msg(received), written)


def test_a_bag_without_ros_holds_the_same():
    types = get_typestore(Stores.ROS2_JAZZY)
    types.register(get_types_from_msg(message_definitions('thinmap_msgs')[NAME], NAME))
    stamp = types.types['builtin_interfaces/msg/Time'](sec=1, nanosec=2)
    header = types.types['std_msgs/msg/Header'](stamp=stamp, frame_id='map')
    for seed in range(20):
        written = random_map(seed)
        message = types.types[NAME](header=header, map_id=7, **flat_topology(written))
        data = bytes(types.serialize_cdr(message, NAME))
        live = messages.topology_msg(written, 'map', 10**9 + 2, map_id=7)
        assert deserialize_message(data, TopologicalMapMsg) == live
        assert_read(topology_from_msg(types.deserialize_cdr(data, NAME)), written)


def small():
    """Two places, and a passage between them of three points and back of two."""
    message = TopologicalMapMsg(header=messages.header('map', 1))
    message.node_ids = [4, 2]
    message.node_kinds = [TopologicalMapMsg.END, TopologicalMapMsg.BRANCH]
    message.node_xy = [1.0, 2.0, 3.0, 2.5]
    message.node_clearance_m = [0.5, 0.25]
    message.edge_ids = [9, 7]
    message.edge_nodes = [1, 0, 0, 1]
    message.edge_length_m = [2.5, 2.25]
    message.edge_clearance_m = [0.25, 0.5]
    message.edge_first = [0, 3]
    message.edge_xy = [3.0, 2.5, 2.0, 2.5, 1.0, 2.0, 1.0, 2.0, 3.0, 2.5]
    return message


def test_the_layout_is_the_documented_one():
    message = small()
    example = re.search(r'(?:^#     .*\n)+', DEFINITION.read_text(), re.MULTILINE)[0]
    code = textwrap.dedent(example.replace('# ', '', 1).replace('\n# ', '\n'))
    there = {'message': message, 'np': np, 'k': 0}
    back = {**there, 'k': 1}
    exec(code, there)
    exec(code, back)
    assert there['ids'] == (2, 4) and back['ids'] == (4, 2)
    assert there['path'].tolist() == [[3.0, 2.5], [2.0, 2.5], [1.0, 2.0]]
    assert back['path'].tolist() == [[1.0, 2.0], [3.0, 2.5]]
    graph = topology_from_msg(message)
    assert graph.nodes[4] == Node(4, NodeKind.END, 1.0, 2.0, 0.5)
    assert graph.nodes[2] == Node(2, NodeKind.BRANCH, 3.0, 2.5, 0.25)
    assert (graph.edges[9].a, graph.edges[9].b, graph.edges[9].length_m) == (2, 4, 2.5)
    assert graph.edges[7].clearance_m == 0.5
    for edge, own in ((graph.edges[9], there), (graph.edges[7], back)):
        assert (edge.a, edge.b) == own['ids'] and edge.path.tolist() == own['path'].tolist()


def test_a_message_without_anything_is_an_empty_map():
    graph = topology_from_msg(TopologicalMapMsg())
    assert not graph.nodes and not graph.edges


def to(name, *values):
    """Change of a field."""
    return lambda message: setattr(message, name, list(values))


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        (
            to('edge_nodes', 1, 0, 0, 2),
            r'edge 7 from node 0 to 2 of 2, .*expected nodes of this map',
        ),
        (
            to('edge_first', 0, 5),
            r'edge_first: \[0, 5\] of 5 points: expected .* one or more for each',
        ),
        (
            to('edge_first', 0, 0),
            r'edge_first: \[0, 0\] of 5 points: expected the first one of each',
        ),
        (to('edge_first', 0, 6), r'edge_first: \[0, 6\] of 5 points: expected'),
        (to('edge_first', 1, 3), r'edge_first: \[1, 3\] of 5 points: expected'),
        (to('edge_first', 0), r'map: edge_first: \(1,\): expected uint32 \(e\); .*e = 2'),
        (to('edge_xy', 0.0, 1.0, 2.0), r'map: edge_xy: \(3,\): expected float32 \(2p\)'),
        (to('edge_xy', *5 * [0.0, np.nan]), r'map: edge_xy\[1\]: nan: expected -1e\+06 to'),
        (
            to('edge_xy', *7 * [0.0], -np.inf, 0.0, 0.0),
            r'map: edge_xy\[7\]: -inf: expected -1e\+06 to',
        ),
        (to('edge_ids', 9, 9), 'edges: 2 of them with 1 ids: expected an id for each'),
        (to('edge_ids', 9, 4), 'edge id 4: expected a positive number that no node has'),
        (to('node_ids', 4, 4), 'nodes: 2 of them with 1 ids: expected an id for each'),
        (to('node_ids', 4, 0), r'map: node_ids\[1\]: 0: expected 1 to 4.29497e\+09'),
        (to('node_ids', 4), r'map: node_kinds: \(2,\): expected uint8 \(n\); n = 1'),
        (to('node_kinds', 0, 7), r'map: node_kinds\[1\]: 7: expected 0 to 2'),
        (to('node_xy', 1.0, 2.0, np.inf, 2.5), r'map: node_xy\[2\]: inf: expected -1e\+06 to'),
        (to('node_xy', 1.0, 2.0), r'map: node_xy: \(2,\): expected float64 \(2n\); n = 2'),
        (to('node_clearance_m', -0.5, 0.5), r'map: node_clearance_m\[0\]: -0.5: expected 0 to'),
        (to('edge_length_m', 2.5, -0.5), r'map: edge_length_m\[1\]: -0.5: expected 0 to'),
        (to('edge_clearance_m', 0.25, np.nan), r'map: edge_clearance_m\[1\]: nan: expected 0 to'),
    ],
)
def test_maps_that_are_none_are_refused(change, reason):
    message = small()
    topology_from_msg(message)
    change(message)
    with pytest.raises(InputError, match=reason) as refused:
        topology_from_msg(message)
    assert '\n' not in str(refused.value)


def test_points_without_edges_are_refused():
    with pytest.raises(InputError, match=r'edge_first: \[\] of 1 points: expected'):
        topology_from_msg(TopologicalMapMsg(edge_xy=[0.0, 1.0]))


def test_ids_of_64_bits_are_read_from_older_bags():
    types = get_typestore(Stores.ROS2_JAZZY)
    words = message_definitions('thinmap_msgs')[NAME].replace(
        'uint32[] node_ids', 'uint64[] node_ids'
    )
    types.register(
        get_types_from_msg(words.replace('uint32[] edge_ids', 'uint64[] edge_ids'), NAME)
    )
    stamp = types.types['builtin_interfaces/msg/Time'](sec=1, nanosec=2)
    header = types.types['std_msgs/msg/Header'](stamp=stamp, frame_id='map')
    written = random_map(3)
    flat = flat_topology(written)
    wide = {name: flat[name].astype(np.uint64) for name in ('node_ids', 'edge_ids')}
    message = types.types[NAME](header=header, map_id=7, **flat | wide)
    data = bytes(types.serialize_cdr(message, NAME))
    assert_read(topology_from_msg(types.deserialize_cdr(data, NAME)), written)
    wide['edge_ids'][0] = 2**32
    with pytest.raises(InputError, match=r'map: edge_ids\[0\]: 4294967296: expected 1 to'):
        topology_from_msg(types.types[NAME](header=header, map_id=7, **flat | wide))


def test_the_types_of_a_bag_are_in_the_words_of_rclpy(tmp_path):
    """So that the player finds a topic whose fields have other types under the same names."""
    names = [NAME, 'sensor_msgs/msg/LaserScan', 'nav_msgs/msg/Odometry', 'tf2_msgs/msg/TFMessage']
    names += ['geometry_msgs/msg/PoseWithCovariance', 'diagnostic_msgs/msg/DiagnosticStatus']
    definitions = message_definitions('thinmap_msgs')
    old = definitions[NAME].replace('uint32[]', 'uint64[]')
    for words in (definitions, {NAME: old}):
        folder = tmp_path / str(len(words))
        writer = BagWriter(folder, live=True, definitions=words)
        for number, name in enumerate(names):
            writer.write(f'/t{number}', name, number + 1, b'0000')
        writer.close()
        bag = Bag(folder)
        for topic, name in bag.topics.items():
            expected = messages.message_class(name).get_fields_and_field_types()
            if words is not definitions and name == NAME:
                expected = {k: v.replace('uint32', 'uint64') for k, v in expected.items()}
            assert bag.fields(topic) == expected
        assert set(bag.topics.values()) == set(names)


def test_a_message_of_an_older_layout_is_refused():
    types = get_typestore(Stores.ROS2_JAZZY)
    types.register(get_types_from_msg('uint32[] nodes\nuint32[] edges\n', NAME))
    old = types.types[NAME](nodes=np.zeros(1), edges=np.zeros(0))
    with pytest.raises(InputError, match='without node_ids: expected the flat arrays of thinmap'):
        topology_from_msg(old)
    types = get_typestore(Stores.ROS2_JAZZY)
    words = '\n'.join(f'string {name}' for name in FIELDS)
    types.register(get_types_from_msg(words, NAME))
    with pytest.raises(InputError, match='expected flat arrays'):
        topology_from_msg(types.types[NAME](**dict.fromkeys(FIELDS, 'many')))


def test_altered_messages_are_refused_in_one_line_or_read():
    rng = np.random.default_rng(0)
    for _ in range(2000):
        message = messages.topology_msg(random_map(5), 'map', 0)
        name = str(rng.choice(list(FIELDS)))
        values = getattr(message, name)
        place = int(rng.integers(len(values)))
        if rng.random() < 0.3:
            del values[place:]
        else:
            data = memoryview(values).cast('B')
            data[int(rng.integers(len(data)))] = int(rng.integers(256))
        try:
            graph = topology_from_msg(message)
        except InputError as error:
            assert '\n' not in str(error)
        else:
            assert list(graph.nodes) == list(message.node_ids)
            assert list(graph.edges) == list(message.edge_ids)


def test_the_same_map_at_another_time_is_the_same():
    message = messages.topology_msg(random_map(5), 'map', 1, map_id=3)
    later = messages.topology_msg(random_map(5), 'map', 2, map_id=3)
    assert messages.is_same_topology(message, later)
    assert not messages.is_same_topology(message, messages.topology_msg(random_map(5), 'map', 1))
    for name in FIELDS:
        changed = messages.topology_msg(random_map(5), 'map', 1, map_id=3)
        getattr(changed, name)[-1] += 1
        assert not messages.is_same_topology(message, changed), name
