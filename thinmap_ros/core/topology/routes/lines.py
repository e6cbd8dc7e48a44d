"""Edges as a route server drives them: straight, one along a line, one at each node at least."""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import Edge
from thinmap_ros.core.topology.routes.editing import EditedGraph, is_drivable
from thinmap_ros.jit import inlined, kernel

_DIRECTIONS = 72


def split_parallels(graph: EditedGraph) -> None:
    """Lead the longer one of two edges between the same nodes over a corner node.

    It stands where the edge is farthest from the line. An edge that no such corner clears goes:
    both would be driven along the same line.
    """
    known: set[tuple[int, int]] = set()
    edges = sorted(graph.map.edges.values(), key=lambda edge: (edge.length_m, edge.id))
    for edge in edges:
        ends = (min(edge.a, edge.b), max(edge.a, edge.b))
        if ends in known or edge.a == edge.b:
            _lead_over_corner(graph, edge)
        known.add(ends)


def _lead_over_corner(graph: EditedGraph, edge: Edge) -> None:
    corner = edge.path[int(_off_line(edge.path).argmax())]
    row, col = graph.frame.cells_of(corner)[0].tolist()
    ends = {graph.cell(edge.a), graph.cell(edge.b)}
    if len(ends) == 2 and all((row, col) != at and graph.is_clear((row, col), at) for at in ends):
        graph.split(edge, graph.put_node(corner))
    else:
        graph.map.drop_edge(edge.id)


def _off_line(path: Array) -> Array:
    """Distance (K,) of the points of a path (K, 2) from the line through its ends."""
    line = path[-1] - path[0]
    off = path - path[0]
    length = max(float(np.hypot(*line)), 1e-9)
    return np.asarray(np.abs(off[:, 0] * line[1] - off[:, 1] * line[0]) / length)


def give_edges(graph: EditedGraph) -> None:
    """Lead an edge from each node without one to the farthest place on a straight line."""
    for node in list(graph.map.nodes.values()):
        if graph.map.edges_at(node.id):
            continue
        cell = graph.cell(node.id)
        place = _farthest(graph.standing, *cell, _DIRECTIONS)
        if place != cell:
            other = graph.put_node(graph.frame.centres_of(np.array([place]))[0])
            graph.put_straight(0, node.id, other)


@kernel
def _farthest(standing: NDArray[np.bool_], row: int, col: int, directions: int) -> tuple[int, int]:
    """The traversable cell that is farthest from one on a straight line over such cells."""
    best = (row, col)
    best_away = 0.0
    for k in range(directions):
        angle = 2.0 * math.pi * k / directions
        away = 0.0
        at = (row, col)
        to = at
        while _is_true(standing, to[0], to[1]):
            at = to
            away += 0.5
            to = (
                int(math.floor(row + 0.5 + away * math.sin(angle))),
                int(math.floor(col + 0.5 + away * math.cos(angle))),
            )
        if away > best_away and is_drivable(standing, row, col, at[0], at[1]):
            best = at
            best_away = away
    return best


@inlined
def _is_true(mask: NDArray[np.bool_], row: int, col: int) -> bool:
    """Whether a cell lies in a mask (H, W) and is true."""
    return bool(0 <= row < mask.shape[0] and 0 <= col < mask.shape[1] and mask[row, col])
