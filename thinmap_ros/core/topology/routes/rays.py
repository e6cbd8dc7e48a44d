"""Branches into rays: space that a laser saw through glass, without walls around."""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.routes.editing import EditedGraph
from thinmap_ros.jit import kernel

_WALL = 2
_UNKNOWN = 1
_REACH_M = 3.0  # beyond, whatever ends a view is no part of the place
_DIRECTIONS = 72


def drop_rays(graph: EditedGraph, patch: GridPatch) -> None:
    """Drop ends that see more of the unknown than of walls, back to the first node that does not.

    A node without edges counts as an end, unless nothing else is left.
    """
    states = _UNKNOWN * patch.unknown.astype(np.uint8) + _WALL * patch.occupied.astype(np.uint8)
    reach = _REACH_M / patch.frame.resolution
    open_ids = [number for number in graph.map.nodes if len(graph.map.edges_at(number)) < 2]
    while open_ids and len(graph.map.nodes) > 1:
        number = open_ids.pop()
        edges = graph.map.edges_at(number) if number in graph.map.nodes else []
        if number not in graph.map.nodes or len(edges) > 1:
            continue
        walls, unknown = _view(states, *graph.cell(number), reach, _DIRECTIONS)
        if unknown > walls:
            open_ids += [edge.other(number) for edge in edges if edge.a != edge.b]
            graph.map.drop_node(number)


@kernel
def _view(
    states: NDArray[np.uint8], row: int, col: int, reach: float, directions: int
) -> tuple[int, int]:
    """Directions in which a view from a cell ends at a wall, and in the unknown, within a reach.

    states (H, W): see the constants, 0 for free; cells outside are unknown; reach in cells.
    """
    walls = 0
    unknown = 0
    for k in range(directions):
        angle = 2.0 * math.pi * k / directions
        away = 0.0
        while away < reach:
            r = int(math.floor(row + 0.5 + away * math.sin(angle)))
            c = int(math.floor(col + 0.5 + away * math.cos(angle)))
            inside = 0 <= r < states.shape[0] and 0 <= c < states.shape[1]
            state = states[r, c] if inside else _UNKNOWN
            if state != 0:
                walls += state == _WALL
                unknown += state == _UNKNOWN
                break
            away += 0.5
    return walls, unknown
