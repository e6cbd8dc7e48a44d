"""The Voronoi topology of simple shapes."""

import numpy as np
import pytest

from thinmap_ros.baselines.voronoi import VoronoiConfig, build_voronoi
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap


def patch_of(cells: np.ndarray) -> GridPatch:
    return GridPatch(GridFrame(5.0, -3.0, 0.1), cells.astype(np.int8))


def tee() -> np.ndarray:
    cells = np.full((70, 120), 100)
    cells[10:20, 10:110] = cells[10:60, 50:60] = 0
    return cells


def kinds(graph: TopologicalMap) -> list[NodeKind]:
    return sorted(node.kind for node in graph.nodes.values())


def test_a_t_of_corridors() -> None:
    graph = build_voronoi(patch_of(tee()))
    assert kinds(graph) == [NodeKind.END] * 3 + [NodeKind.BRANCH] and len(graph.edges) == 3
    (branch,) = (node for node in graph.nodes.values() if node.kind == NodeKind.BRANCH)
    assert np.hypot(branch.x - 10.5, branch.y + 1.5) <= 0.3
    assert branch.clearance_m >= 0.5
    for edge in graph.edges.values():
        assert np.array_equal(edge.path[0], graph.nodes[edge.a].position)
        assert np.array_equal(edge.path[-1], graph.nodes[edge.b].position)
        assert edge.clearance_m >= 0.25


def test_a_ring_gets_a_node() -> None:
    cells = np.full((80, 80), 100)
    cells[10:70, 10:70] = 0
    cells[22:58, 22:58] = 100
    graph = build_voronoi(patch_of(cells))
    assert len(graph.edges) == len(graph.nodes) >= 1 and len(graph.components()) == 1


def test_longer_pruning_leaves_less() -> None:
    rng = np.random.default_rng(3)
    cells = tee()
    cells[10, rng.integers(10, 50, 12)] = 100
    counts = [
        len(build_voronoi(patch_of(cells), VoronoiConfig(prune_m=m)).nodes) for m in (0.0, 0.3, 1.0)
    ]
    assert counts[0] > counts[1] >= counts[2]
    assert counts[2] == 4


@pytest.mark.parametrize('value', [100, -1, 0])
def test_maps_of_one_value(value: int) -> None:
    graph = build_voronoi(patch_of(np.full((20, 30), value)))
    assert (len(graph.nodes) > 0) == (value == 0)


def test_no_line_leaves_the_free_space() -> None:
    patch = patch_of(tee())
    graph = build_voronoi(patch, VoronoiConfig(prune_m=0.0))
    for edge in graph.edges.values():
        cells = patch.frame.cells_of(edge.path)
        assert patch.free[cells[:, 0], cells[:, 1]].all()
