"""Ids of two topological maps in that of their joined grid."""

import numpy as np

from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.registry import MATCH_RADIUS_M
from thinmap_ros.core.topology.topology import TopologyBuilder, build, join_topologies, with_ids_of

FRAME = GridFrame(0.0, 0.0, 0.1)


def corridors(first_col, end_col):
    """Part of a corridor along x with branches along y every 6 m."""
    cells = np.full((140, 400), 100, dtype=np.int8)
    cells[62:78, 10:390] = 0
    for col in range(50, 390, 60):
        cells[10:130, col - 8 : col + 8] = 0
    cells[:, :first_col] = UNKNOWN
    cells[:, end_col:] = UNKNOWN
    return GridPatch(FRAME, cells)


def graph_of(patch):
    return build(patch, None, TopologyConfig())


def test_nodes_of_both_keep_ids_and_shared_ones_have_that_of_the_first():
    first = graph_of(corridors(0, 250))
    second = graph_of(corridors(150, 400))
    next_id = max([*first.nodes, *first.edges]) + 1
    builder, ids = join_topologies(corridors(0, 400), first, second, next_id)
    graph = builder.map
    assert len(set(ids.values())) == len(ids)
    shared = [own for own, new in ids.items() if new in first.nodes]
    assert shared
    for own, new in ids.items():
        away = graph.nodes[new].position - second.nodes[own].position
        assert np.hypot(*away) <= 2.0 * MATCH_RADIUS_M
        assert (new in first.nodes) or new >= next_id
    stayed = first.nodes.keys() & graph.nodes.keys()
    assert len(stayed) >= len(first.nodes) - 4  # the ends at its border are gone
    fresh = (graph.nodes.keys() | graph.edges.keys()) - first.nodes.keys() - first.edges.keys()
    assert min(fresh) >= next_id
    assert builder.next_id > max(fresh)


def test_two_nodes_at_one_place_do_not_share_an_id():
    first = graph_of(corridors(0, 400))
    node = next(iter(first.nodes.values()))
    twin = TopologicalMap([node, type(node)(node.id + 5000, node.kind, node.x + 0.05, node.y, 1.0)])
    _, ids = join_topologies(corridors(0, 400), first, twin, 9000)
    assert ids == {node.id: node.id}


def test_a_part_in_which_neither_map_has_a_node_is_not_published():
    patch = corridors(0, 400)
    cells = patch.cells.copy()
    cells[:, 200:204] = 100
    parts = GridPatch(FRAME, cells)
    left = graph_of(corridors(0, 195))
    builder = TopologyBuilder.continued(parts, left, 5000)
    assert builder.map.nodes
    assert max(node.x for node in builder.map.nodes.values()) < 20.2


def test_a_continued_builder_never_assigns_an_id_again():
    patch = corridors(0, 250)
    builder = TopologyBuilder.continued(patch, graph_of(patch), 7000)
    before = set(builder.map.nodes) | set(builder.map.edges)
    builder.update(corridors(0, 400), np.array([20.0, 7.0, 0.0]))
    new = (set(builder.map.nodes) | set(builder.map.edges)) - before
    assert new
    assert min(new) >= 7000


def test_a_map_takes_the_ids_of_a_known_one():
    known = graph_of(corridors(0, 250))
    other = graph_of(corridors(150, 400))
    found = with_ids_of(known, other, 9000)
    for mine, own in zip(found.nodes.values(), other.nodes.values(), strict=True):
        assert mine.position.tolist() == own.position.tolist()
    shared = found.nodes.keys() & known.nodes.keys()
    assert shared and min(found.nodes.keys() - shared) >= 9000
    for number in shared:
        away = found.nodes[number].position - known.nodes[number].position
        assert np.hypot(*away) <= MATCH_RADIUS_M
    same = found.edges.keys() & known.edges.keys()
    assert same
    for number in same:
        ends = ({edge.a, edge.b} for edge in (found.edges[number], known.edges[number]))
        assert next(ends) == next(ends)


def test_a_map_has_its_own_ids_again():
    known = graph_of(corridors(0, 400))
    again = with_ids_of(known, with_ids_of(TopologicalMap(), known, 9000), 20000)
    assert again.nodes == known.nodes and again.edges.keys() == known.edges.keys()
