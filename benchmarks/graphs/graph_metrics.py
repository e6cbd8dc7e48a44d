"""Metrics of topological maps: drivable edges, completeness, sight, agreement."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from benchmarks.graphs.route_measures import (
    STRAIGHT_AND_DIAGONAL,
    distance_m,
    grid_links,
    numbered,
)
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap

Mask = NDArray[np.bool_]
_SAMPLE_CELLS = 0.1  # sampling step of straight lines
_ATTACH = 8  # nearest nodes to which a cell is connected
_IN_SIGHT = 12  # nearest nodes that are looked for in a straight line


def loop_count(graph: TopologicalMap) -> int:
    """Number of independent cycles of a graph."""
    return len(graph.edges) - len(graph.nodes) + len(graph.components())


def hole_count(free: Mask) -> int:
    """Number of parts of the other cells that free cells (H, W), joined over corners, enclose."""
    return int(ndimage.label(~np.pad(free, 1))[1]) - 1


def clearance_m(patch: GridPatch) -> Array:
    """Distance (H, W) from the nearest occupied cell, centres, m; cells outside are occupied."""
    return distance_m(~patch.occupied, patch.frame)


def drivable_share(patch: GridPatch, graph: TopologicalMap, radius_m: float) -> float:
    """Share of edges with a straight line at least a radius from obstacles (0.1 cell steps)."""
    standing = clearance_m(patch) >= radius_m - 1e-9
    good = sum(
        _is_drivable(patch, standing, graph.nodes[edge.a].position, graph.nodes[edge.b].position)
        for edge in graph.edges.values()
    )
    return good / max(len(graph.edges), 1)


def sight_share(
    patch: GridPatch, graph: TopologicalMap, free: Mask, count: int, seed: int
) -> float:
    """Share of random cells that one of the 12 nearest nodes can be driven to in a straight line.

    free (H, W): traversable cells, among which the cells are and the lines stay (0.1 cell steps).
    """
    cells = np.argwhere(free)
    if not len(cells) or not graph.nodes:
        return 0.0
    chosen = cells[np.random.default_rng(seed).integers(0, len(cells), count)]
    places = patch.frame.centres_of(chosen)
    nodes = np.array([node.position for node in graph.nodes.values()])
    nearest = np.asarray(cKDTree(nodes).query(places, min(_IN_SIGHT, len(nodes)))[1])
    seeing = sum(
        any(_is_drivable(patch, free, place, nodes[k]) for k in row)
        for place, row in zip(places, nearest.reshape(count, -1), strict=True)
    )
    return seeing / count


def _is_drivable(patch: GridPatch, standing: Mask, a: Array, b: Array) -> bool:
    """Whether the straight line between two points stays on cells (H, W)."""
    steps = math.ceil(float(np.hypot(*(b - a))) / (_SAMPLE_CELLS * patch.frame.resolution)) + 1
    cells = patch.frame.cells_of(a + np.linspace(0.0, 1.0, max(2, steps))[:, None] * (b - a))
    return bool(standing[cells[:, 0], cells[:, 1]].all())


def agreement(one: TopologicalMap, other: TopologicalMap, reach_m: float) -> tuple[float, float]:
    """Share of the nodes of each map with a node of the other map within reach."""
    if not one.nodes or not other.nodes:
        return (float(not other.nodes), float(not one.nodes))
    first, second = (
        np.array([node.position for node in graph.nodes.values()]) for graph in (one, other)
    )
    there = np.asarray(cKDTree(second).query(first)[0])
    back = np.asarray(cKDTree(first).query(second)[0])
    return float((there <= reach_m).mean()), float((back <= reach_m).mean())


def completeness(
    patch: GridPatch, graph: TopologicalMap, radius_m: float, pairs: int, seed: int
) -> tuple[float, float]:
    """Share of reachable random pairs of cells that a graph connects, and relative path length.

    A path leads from a cell over the grid to one of the nearest nodes, then along straight lines
    between nodes. Its length is relative to the shortest path over cells with the same clearance.
    The mean is over all connected pairs.
    """
    standing = clearance_m(patch) >= radius_m - 1e-9
    links = grid_links(standing, STRAIGHT_AND_DIAGONAL)
    parts = ndimage.label(standing, np.ones((3, 3)))[0][standing]
    rng = np.random.default_rng(seed)
    sources = rng.integers(0, len(parts), pairs)
    targets = [int(rng.choice(np.flatnonzero(parts == parts[k]))) for k in sources]
    order = list(graph.nodes)
    places = patch.frame.cells_of(np.array([graph.nodes[k].position for k in order]))
    at_nodes = numbered(standing)[places[:, 0], places[:, 1]]
    between = csgraph.dijkstra(
        _straight_lines(graph, order, patch.frame.resolution), directed=False
    )
    found = []
    best = []
    for source, target in zip(sources.tolist(), targets, strict=True):
        from_source, from_target = csgraph.dijkstra(links, directed=False, indices=[source, target])
        first, last = (_nearest(lengths, at_nodes) for lengths in (from_source, from_target))
        lengths = (
            from_source[at_nodes[first], None]
            + between[np.ix_(first, last)]
            + from_target[at_nodes[last]]
        )
        length = float(lengths.min(initial=np.inf))
        if math.isfinite(length):
            found.append(length)
            best.append(float(from_source[target]))
    return len(found) / pairs, sum(found) / max(sum(best), 1.0)


def _nearest(lengths: Array, at_nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices of the nearest nodes, by path length on the grid."""
    distance = np.where(at_nodes >= 0, lengths[at_nodes], np.inf)
    nearest = np.argsort(distance, kind='stable')[:_ATTACH]
    return nearest[np.isfinite(distance[nearest])]


def _straight_lines(
    graph: TopologicalMap, order: list[int], resolution: float
) -> sparse.csr_matrix:
    """Lengths, in cells, of straight lines between connected nodes."""
    index = {node: k for k, node in enumerate(order)}
    lines: dict[tuple[int, int], float] = {}
    for edge in graph.edges.values():
        a, b = sorted((index[edge.a], index[edge.b]))
        length = (
            float(np.hypot(*(graph.nodes[edge.a].position - graph.nodes[edge.b].position)))
            / resolution
        )
        lines[a, b] = min(lines.get((a, b), math.inf), length)
    ends = np.array(list(lines), dtype=np.int64).reshape(-1, 2)
    return sparse.csr_matrix(
        (list(lines.values()), (ends[:, 0], ends[:, 1])), shape=(len(order), len(order))
    )
