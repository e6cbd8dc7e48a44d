"""Graphs of maps of other publishers: ids stay from map to map."""

import math

import numpy as np
import pytest

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.se2 import pose
from thinmap_ros.core.topology.graph import NodeKind, TopologyConfig
from thinmap_ros.core.topology.topology import MapGraph, build, build_again

SECOND_NS = 1_000_000_000
AT = pose(1.0, 3.0, 0.0)


def crossing(known_cols=120, resolution=0.05, origin=(0.0, 0.0)):
    """Two corridors 1 m wide that cross, 6 x 6 m, known up to a column."""
    cells = np.full((120, 120), 100, dtype=np.int8)
    cells[50:70, 2:118] = 0
    cells[2:118, 50:70] = 0
    cells[:, known_cols:] = -1
    return GridPatch(GridFrame(*origin, resolution), cells)


def shifted(patch, rows, cols):
    """The same map with unknown cells before its first rows and columns."""
    cells = np.pad(patch.cells, ((rows, 0), (cols, 0)), constant_values=-1)
    return GridPatch(patch.frame.with_origin_at(-rows, -cols), cells)


def test_the_graph_keeps_its_ids_while_the_map_grows_and_its_origin_shifts():
    graph = MapGraph(TopologyConfig())
    first = graph.update(crossing(known_cols=90), AT, 0)
    branch = next(n for n in first.nodes.values() if n.kind == NodeKind.BRANCH)
    places = {n.id: (n.x, n.y) for n in first.nodes.values()}
    patch = crossing(origin=(0.0, 0.0))
    second = graph.update(shifted(patch, 13, 7), AT, 3 * SECOND_NS)
    expected = build(patch, (1.0, 3.0), TopologyConfig())
    assert len(second.nodes) == len(expected.nodes)
    assert len(second.edges) == len(expected.edges)
    assert second.nodes[branch.id].kind == NodeKind.BRANCH
    kept = second.nodes.keys() & places.keys()
    assert len(kept) >= 4
    for node_id in kept:
        node = second.nodes[node_id]
        assert math.dist(places[node_id], (node.x, node.y)) <= 0.5
    # The end towards the unknown has moved: it is another node.
    assert len(second.nodes.keys() - places.keys()) == 1


def test_the_graph_is_built_again_after_a_period_and_only_of_another_map():
    graph = MapGraph(TopologyConfig())
    patch = crossing(known_cols=90)
    first = graph.update(patch, AT, 0)
    grown = crossing()
    assert graph.update(grown, AT, SECOND_NS) is first
    second = graph.update(grown, AT, 2 * SECOND_NS)
    assert second is not first
    assert graph.update(grown, AT, 9 * SECOND_NS) is second
    # The clock was set back.
    assert graph.update(patch, AT, 0) is not second


def test_where_the_robot_stands_in_no_free_space_the_last_graph_holds():
    graph = MapGraph(TopologyConfig())
    first = graph.update(crossing(), AT, 0)
    cells = np.full((120, 120), -1, dtype=np.int8)
    unknown = GridPatch(GridFrame(0.0, 0.0, 0.05), cells)
    assert graph.update(unknown, AT, 9 * SECOND_NS) is first


def test_ids_are_never_given_twice():
    last = None
    seen = set()
    for known_cols in (80, 100, 120, 90, 120):
        fresh = build(crossing(known_cols), (1.0, 3.0), TopologyConfig())
        last = build_again(last, crossing(known_cols), (1.0, 3.0), TopologyConfig())
        found = last.map
        used = [*found.nodes, *found.edges]
        assert len(used) == len(set(used))
        assert {n.kind for n in found.nodes.values()} == {n.kind for n in fresh.nodes.values()}
        assert sorted(e.length_m for e in found.edges.values()) == sorted(
            e.length_m for e in fresh.edges.values()
        )
        seen |= set(used)
    assert max(seen) == len(seen)


def test_ids_stay_where_the_next_map_lies_on_other_cells():
    first = build_again(None, crossing(), (1.0, 3.0), TopologyConfig())
    patch = crossing(origin=(0.013, -0.021))
    second = build_again(first, patch, (1.0, 3.0), TopologyConfig())
    assert second.map.nodes.keys() == first.map.nodes.keys()
    assert second.map.edges.keys() == first.map.edges.keys()
    for node in second.map.nodes.values():
        before = first.map.nodes[node.id]
        assert (node.x - before.x, node.y - before.y) == pytest.approx((0.013, -0.021))


def test_parallel_edges_keep_their_own_ids():
    cells = np.full((60, 120), 100, dtype=np.int8)
    cells[4:56, 4:116] = 0
    cells[20:30, 20:100] = 100
    cells[44:46, 50:60] = 100
    patch = GridPatch(GridFrame(0.0, 0.0, 0.05), cells)
    first = build_again(None, patch, (0.5, 0.5), TopologyConfig())
    lengths = {e.id: e.length_m for e in first.map.edges.values()}
    second = build_again(first, patch, (0.5, 0.5), TopologyConfig())
    assert {e.id: e.length_m for e in second.map.edges.values()} == lengths
