"""The route graph of a map that grows, as topology_builder writes it for a route server."""

import numpy as np
import pytest

from benchmarks.graphs.graph_metrics import drivable_share
from thinmap_ros.core.grid.edits import KeepOut
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import TopologyBuilder
from thinmap_ros.nodes.parts.topology import RouteGraph

CONFIG = TopologyConfig()
AREA = np.array([(9.0, 0.5), (10.0, 0.5), (10.0, 4.0), (9.0, 4.0)])


def two_ways(gap=0):
    """Two corridors of 20 m with joined ends; `gap` columns in the middle of both are unknown."""
    cells = np.full((90, 220), 100, dtype=np.int8)
    cells[10:80, 10:210] = 0
    cells[30:60, 30:190] = 100
    cells[10:80, 110 : 110 + gap] = np.where(cells[10:80, 110 : 110 + gap] == 0, UNKNOWN, 100)
    return GridPatch(GridFrame(0.0, 0.0, 0.1), cells)


def state_of(patch, *poses):
    builder = TopologyBuilder(CONFIG)
    builder.update(patch, np.array(poses or [(2.0, 2.0, 0.0)]))
    return builder.state(), builder.map


class Written:
    """A route graph, and what it wrote."""

    def __init__(self):
        self.graphs = []
        self.fails = False
        self.route_graph = RouteGraph(CONFIG, self._write)

    def _write(self, graph):
        if self.fails:
            raise OSError('no space left')
        self.graphs.append(graph)

    def update(self, state, keep_out=None, is_forced=False):
        return self.route_graph.update(state, keep_out or KeepOut(), is_forced)


def crossings(graph):
    """Edges that cross x = 9.5 m."""
    ends = [(graph.nodes[e.a].x, graph.nodes[e.b].x) for e in graph.edges.values()]
    return sum(min(pair) < 9.5 < max(pair) for pair in ends)


def test_an_area_closes_one_of_two_ways_and_leaves_the_ids():
    state, topology = state_of(two_ways())
    written = Written()
    before = written.update(state)
    closed = written.update(state, KeepOut().with_area(AREA, is_wall=False))
    assert (crossings(before), crossings(closed)) == (2, 1)
    after = written.update(state)
    assert crossings(after) == 2
    assert written.graphs == [before, closed, after]
    far = [node.id for node in before.nodes.values() if node.x > 12.0]
    assert far
    for number in far:
        assert before.nodes[number].position == pytest.approx(after.nodes[number].position)
    assert set(far) <= closed.nodes.keys()
    assert topology.nodes.keys() & before.nodes.keys()
    news = {*closed.nodes, *closed.edges} - {*topology.nodes, *topology.edges}
    assert min(news) >= 1_000_000_000


def test_a_wall_across_both_ways_leaves_the_part_where_the_robot_has_been():
    state, _ = state_of(two_ways())
    wall = KeepOut().with_area(np.array([(9.5, -1.0), (9.5, 12.0)]), is_wall=True)
    found = Written().update(state, wall)
    assert found.edges and max(node.x for node in found.nodes.values()) < 9.5
    both, _ = state_of(two_ways(), (2.0, 2.0, 0.0), (18.0, 2.0, 0.0))
    assert len(Written().update(both, wall).components()) == 2


def test_no_edge_crosses_the_unknown_that_the_map_that_grows_takes_for_free():
    patch = two_ways(gap=2)
    state, topology = state_of(patch)
    assert max(node.x for node in topology.nodes.values()) > 12.0
    found = Written().update(state)
    assert max(node.x for node in found.nodes.values()) < 11.0
    assert found.edges and drivable_share(patch, found, CONFIG.robot_radius_m) == 1.0


def test_a_graph_is_written_again_only_where_it_has_changed_or_is_asked_for():
    state, _ = state_of(two_ways())
    written = Written()
    first = written.update(state)
    assert written.update(state) is first and len(written.graphs) == 1
    # Another cell, the same graph.
    cells = two_ways().cells.copy()
    cells[0, 0] = UNKNOWN
    other, _ = state_of(GridPatch(two_ways().frame, cells))
    assert written.update(other) is first and len(written.graphs) == 1
    written.update(state, is_forced=True)
    assert len(written.graphs) == 2


def test_a_graph_that_could_not_be_written_is_written_the_next_time():
    state, _ = state_of(two_ways())
    written = Written()
    written.fails = True
    with pytest.raises(OSError, match='no space left'):
        written.update(state)
    written.fails = False
    assert written.graphs == [] and written.update(state) is written.graphs[0]


def test_a_graph_without_edges_is_not_written():
    state, _ = state_of(two_ways())
    written = Written()
    everywhere = KeepOut().with_area(np.array([(-1, -1), (23, -1), (23, 10), (-1, 10.0)]), False)
    assert isinstance(written.update(state, everywhere), TopologicalMap)
    assert written.graphs == []
