"""Topological map from the Voronoi diagram, which the papers compare with thinning.

Source: topological map paper sections 1 and 4 (hierarchical map building); Zwynsvoorde et al.,
"Incremental topological modeling using local Voronoi-like graphs", 2000.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import Voronoi

from thinmap_ros.core.config import Config, parameter, robot_radius
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap

Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class VoronoiConfig(Config):
    """Parameters of the selection of vertices and ridges."""

    robot_radius_m: float = robot_radius()
    prune_m: float = parameter(
        1.0, 'dead ends up to this long are dropped, again and again, m', low=0.0, high=50.0
    )


def build_voronoi(patch: GridPatch, config: VoronoiConfig | None = None) -> TopologicalMap:
    """Topological map (m, map frame) from the Voronoi diagram of the cells that bound free space.

    A ridge of the diagram is used if both its ends lie on free cells, at least robot_radius_m from
    their obstacle centres. Dead ends up to prune_m long are removed, shortest first, until there
    are none. Nodes are the ends of one, or of three and more ridges, and one point of each ring
    without nodes. Clearances are distances to the nearest obstacle centre.
    """
    config = config or VoronoiConfig()
    solid = ~patch.free
    border = (
        np.argwhere(np.pad(solid, 1, constant_values=True) & _beside(np.pad(patch.free, 1))) - 1
    )
    if len(border) < 4 or not patch.free.any():
        return TopologicalMap()
    diagram = Voronoi(patch.frame.centres_of(border))
    vertices = diagram.vertices
    clearance = np.full(len(diagram.vertices), np.inf)
    ridges = np.array(diagram.ridge_vertices)
    centres = diagram.points[diagram.ridge_points[:, :1]]
    gap = np.hypot(*(vertices[np.maximum(ridges, 0)] - centres).transpose(2, 0, 1))
    for side in (0, 1):
        np.minimum.at(
            clearance,
            np.maximum(ridges[:, side], 0),
            np.where(ridges[:, side] < 0, np.inf, gap[:, side]),
        )
    allowed = (clearance >= config.robot_radius_m) & _on_free_cells(patch, vertices)
    kept = ridges[(ridges >= 0).all(axis=1) & allowed[ridges].all(axis=1)]
    kept = _pruned(vertices, kept[kept[:, 0] != kept[:, 1]], config.prune_m)
    return _graph_of(vertices, clearance, kept)


def _beside(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells (H, W) with a true cell among their eight neighbours."""
    near: NDArray[np.bool_] = ndimage.binary_dilation(cells, np.ones((3, 3), dtype=np.bool_))
    return near


def _on_free_cells(patch: GridPatch, points: Array) -> NDArray[np.bool_]:
    inside = patch.contains(points)
    cells = np.clip(patch.frame.cells_of(points), 0, np.array(patch.shape) - 1)
    free: NDArray[np.bool_] = inside & patch.free[cells[:, 0], cells[:, 1]]
    return free


def _degrees(ridges: Numbers, count: int) -> Numbers:
    return np.asarray(np.bincount(ridges.ravel(), minlength=count), dtype=np.int64)


def _chains(ridges: Numbers, count: int) -> list[list[int]]:
    """Vertices of each chain of ridges between vertices of degree one or above two; rings last."""
    ends = np.concatenate([ridges, ridges[:, ::-1]])
    ends = ends[np.argsort(ends[:, 0], kind='stable')]
    starts = np.searchsorted(ends[:, 0], np.arange(count + 1))
    neighbours = ends[:, 1]
    degree = np.diff(starts)
    used: set[tuple[int, int]] = set()
    chains = []
    firsts = (
        np.flatnonzero((degree > 0) & (degree != 2)).tolist() + np.flatnonzero(degree == 2).tolist()
    )
    for first in firsts:
        if degree[first] == 2 and any(
            (first, int(to)) in used for to in neighbours[starts[first] : starts[first + 1]]
        ):
            continue
        for second in neighbours[starts[first] : starts[first + 1]].tolist():
            if (first, second) in used:
                continue
            chain = [first, second]
            used |= {(first, second), (second, first)}
            while degree[chain[-1]] == 2 and chain[-1] != first:
                one, other = neighbours[starts[chain[-1]] : starts[chain[-1] + 1]].tolist()
                chain.append(other if one == chain[-2] else one)
                used |= {(chain[-2], chain[-1]), (chain[-1], chain[-2])}
            chains.append(chain)
    return chains


def _length(vertices: Array, chain: list[int]) -> float:
    return float(np.hypot(*np.diff(vertices[chain], axis=0).T).sum())


def _pruned(vertices: Array, ridges: Numbers, prune_m: float) -> Numbers:
    """Remove dead ends up to prune_m long from ridges (M, 2).

    A part that is nothing else keeps its longest one.
    """
    while True:
        degree = _degrees(ridges, len(vertices))
        dead = [
            c for c in _chains(ridges, len(vertices)) if (degree[c[0]] == 1) != (degree[c[-1]] == 1)
        ]
        short = [
            (length, chain) for chain in dead if (length := _length(vertices, chain)) <= prune_m
        ]
        if not short:
            return ridges
        gone: set[tuple[int, int]] = set()
        touched: set[int] = set()
        for _, chain in sorted(short):
            base = chain[0] if degree[chain[0]] != 1 else chain[-1]
            # One dead end per junction and iteration: its removal may extend the other chains.
            if base not in touched:
                touched.add(base)
                gone |= {(min(a, b), max(a, b)) for a, b in pairwise(chain)}
        keep = [(min(a, b), max(a, b)) not in gone for a, b in ridges.tolist()]
        ridges = ridges[keep]


def _graph_of(vertices: Array, clearance: Array, ridges: Numbers) -> TopologicalMap:
    degree = _degrees(ridges, len(vertices))
    chains = _chains(ridges, len(vertices))
    ids: dict[int, int] = {}
    result = TopologicalMap()
    for vertex in dict.fromkeys(end for chain in chains for end in (chain[0], chain[-1])):
        ids[vertex] = len(ids) + 1
        inner = NodeKind.BRANCH if degree[vertex] > 2 else NodeKind.CORNER
        kind = NodeKind.END if degree[vertex] < 2 else inner
        x, y = vertices[vertex].tolist()
        result.put_node(Node(ids[vertex], kind, x, y, float(clearance[vertex])))
    for number, chain in enumerate(chains, len(ids) + 1):
        ends = ids[chain[0]], ids[chain[-1]]
        room = float(clearance[chain].min())
        result.put_edge(Edge(number, *ends, vertices[chain], _length(vertices, chain), room))
    return result
