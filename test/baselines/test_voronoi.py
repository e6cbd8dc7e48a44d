"""The Voronoi topology of simple shapes, and that only its lines differ from those of thinning."""

from itertools import pairwise

import numpy as np
import pytest

from benchmarks.graphs.graph_metrics import (
    drivable_share,
    hole_count,
    loop_count,
    sight_share,
)
from thinmap_ros.baselines.voronoi import build_voronoi, voronoi_lines
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.thinning import select_free_space, thin
from thinmap_ros.core.topology.topology import build, build_along

CONFIG = TopologyConfig()


def patch_of(cells: np.ndarray) -> GridPatch:
    return GridPatch(GridFrame(5.0, -3.0, 0.1), cells.astype(np.int8))


def tee() -> np.ndarray:
    cells = np.full((70, 120), 100)
    cells[10:20, 10:110] = cells[10:60, 50:60] = 0
    return cells


def ring() -> np.ndarray:
    cells = np.full((80, 80), 100)
    cells[10:70, 10:70] = 0
    cells[22:58, 22:58] = 100
    return cells


def halls() -> np.ndarray:
    """Two halls with pillars, a corridor that bends, and walls of one cell between them."""
    cells = np.full((120, 200), 100)
    cells[5:80, 5:90] = cells[5:80, 91:180] = 0
    cells[30:34, 88:94] = 100
    cells[40:55, 90] = 0
    for row, col in ((20, 20), (50, 30), (30, 60), (40, 130), (60, 160)):
        cells[row : row + 6, col : col + 4] = 100
    cells[78:100, 20:30] = cells[90:100, 20:150] = cells[78:100, 140:150] = 0
    return cells


def kinds(graph: TopologicalMap) -> list[NodeKind]:
    return sorted(node.kind for node in graph.nodes.values())


def contents(graph: TopologicalMap) -> list[tuple[float, ...]]:
    nodes = [(node.x, node.y, node.kind, node.clearance_m) for node in graph.nodes.values()]
    return sorted(nodes) + sorted(
        (edge.length_m, edge.clearance_m) for edge in graph.edges.values()
    )


def test_a_t_of_corridors() -> None:
    graph = build_voronoi(patch_of(tee()))
    assert kinds(graph) == kinds(build(patch_of(tee()), None, CONFIG))
    assert kinds(graph).count(NodeKind.END) == 3
    (branch,) = (node for node in graph.nodes.values() if node.kind == NodeKind.BRANCH)
    assert np.hypot(branch.x - 10.5, branch.y + 1.5) <= 0.3
    assert branch.clearance_m >= 0.5
    for edge in graph.edges.values():
        assert np.array_equal(edge.path[0], graph.nodes[edge.a].position)
        assert np.array_equal(edge.path[-1], graph.nodes[edge.b].position)
        assert edge.clearance_m >= 0.25


def test_a_ring_gets_nodes() -> None:
    graph = build_voronoi(patch_of(ring()))
    assert len(graph.edges) == len(graph.nodes) >= 1
    assert len(graph.components()) == 1


def test_longer_pruning_leaves_less() -> None:
    cells = tee()
    cells[20:35, 20:28] = 0
    ends = [
        kinds(build_voronoi(patch_of(cells), TopologyConfig(min_branch_length_m=m))).count(
            NodeKind.END
        )
        for m in (0.6, 2.0)
    ]
    assert ends == [4, 3]


@pytest.mark.parametrize('value', [100, -1, 0])
def test_maps_of_one_value(value: int) -> None:
    graph = build_voronoi(patch_of(np.full((20, 30), value)))
    assert (len(graph.nodes) > 0) == (value == 0)


@pytest.mark.parametrize('cells', [tee(), ring(), halls()])
def test_both_graphs_follow_equal_rules(cells: np.ndarray) -> None:
    patch = patch_of(cells)
    free = select_free_space(patch, None, CONFIG)
    # The rules from the lines on: of the same lines they make the same graph.
    assert contents(build_along(patch, free, thin(free), CONFIG)) == contents(
        build(patch, None, CONFIG)
    )
    lines = voronoi_lines(patch, free, CONFIG)
    assert not (lines & ~free).any()
    for graph in (build(patch, None, CONFIG), build_voronoi(patch, CONFIG)):
        assert loop_count(graph) == hole_count(free)
        assert len(graph.components()) == 1
        assert drivable_share(patch, graph, CONFIG.robot_radius_m) == 1.0
        assert sight_share(patch, graph, free, 200, 0) >= 0.99


def test_no_line_leaves_the_free_space() -> None:
    patch = patch_of(halls())
    free = select_free_space(patch, None, CONFIG)
    for edge in build_voronoi(patch).edges.values():
        cells = patch.frame.cells_of(edge.path)
        assert free[cells[:, 0], cells[:, 1]].all()
        assert all(np.abs(b - a).max() <= 1 for a, b in pairwise(cells))


def test_a_node_behind_a_wall_is_not_seen() -> None:
    patch = patch_of(ring())
    free = select_free_space(patch, None, CONFIG)
    graph = build(patch, None, CONFIG)
    (first, *others) = graph.nodes
    for number in others:
        graph.drop_node(number)
    assert 0.0 < sight_share(patch, graph, free, 200, 0) < 0.9
    assert first in graph.nodes
