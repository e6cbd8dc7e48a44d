"""Skeleton of the free space -> end, branch and corner nodes, and edges with their cell paths."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.components import reachable
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.config import TopologyConfig
from thinmap_ros.core.topology.corners import corner_indices
from thinmap_ros.core.topology.free_space import (
    column_distance,
    known_free,
    squared_clearance,
    true_cells,
)
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap
from thinmap_ros.core.topology.net import DONE, Net, net_of, state_of, web_of_net
from thinmap_ros.core.topology.pruning import Limits, Outlook
from thinmap_ros.core.topology.simplify import simplify_net
from thinmap_ros.core.topology.skeleton_graph import Chain, Web, room_along
from thinmap_ros.core.topology.thinning import thin
from thinmap_ros.core.topology.tracing import trace

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
Measure = Callable[[Cells], Cells]


def extract(free_cells: Mask, patch: GridPatch, config: TopologyConfig) -> TopologicalMap:
    """Topological map of the free space of a patch.

    free_cells (H, W) bool: where the robot can stand (`select_free_space`). Ids count from 1:
    nodes, then edges. A part of the free space that thinning erases whole keeps one node, at its
    roomiest cell. Source: exploration paper section 2.2.
    """
    known = known_free(patch, config)
    distance = column_distance(known)
    net = simplified(
        skeleton_of(free_cells, distance),
        lambda cells: squared_clearance(distance, cells),
        Outlook.of(known, patch.occupied, rim_is_unknown=False),
        Limits.of(config, patch.frame.resolution),
    )
    return map_of(web_of_net(net), patch.frame, config)


def skeleton_of(free_cells: Mask, distance: NDArray[np.int16]) -> Mask:
    """Thinned free cells.

    Each part that thinning erases whole (2 x 2 blobs and what shrinks to one) keeps a cell.
    """
    skeleton = thin(free_cells)
    lost = free_cells & ~reachable(free_cells, true_cells(skeleton))
    while lost.any():
        part = np.argwhere(reachable(lost, np.argwhere(lost)[:1]))
        row, col = part[int(squared_clearance(distance, part).argmax())]
        skeleton[row, col] = True
        lost[part[:, 0], part[:, 1]] = False
    return skeleton


def net_along(skeleton: Mask, measure: Measure, pinned: Mask | None = None, room: int = 1) -> Net:
    """Spots and chains of a skeleton (H, W).

    measure: squared clearances of cells (N, 2); pinned (H, W): cells that become spots; room: from
    `net_of`.
    """
    nodes, ends, starts, path = trace(skeleton, pinned)
    cells = np.concatenate([nodes, path])
    measured = np.column_stack([cells, measure(cells)])
    return net_of(measured[: len(nodes)], ends, starts, measured[len(nodes) :], room)


def simplified(skeleton: Mask, measure: Measure, outlook: Outlook, limits: Limits) -> Net:
    """Spots and chains of a skeleton (H, W) without those that only noise made."""
    room = 1
    while True:
        net = net_along(skeleton, measure, room=room)
        simplify_net(net, np.ones(len(net.spots), dtype=np.bool_), outlook, limits)
        if state_of(net) == DONE:
            return net
        room *= 2


def map_of(web: Web, frame: GridFrame, config: TopologyConfig) -> TopologicalMap:
    """The topological map of a web, with corner nodes; ids count from 1: nodes, then edges."""
    result = TopologicalMap()
    radius = config.robot_radius_m / frame.resolution
    numbers = {spot: number for number, spot in enumerate(web.spots, 1)}
    for spot, number in numbers.items():
        result.put_node(
            node_of(
                number, kind_of(web, spot), web.spots[spot].cell, web.spots[spot].squared, frame
            )
        )
    pieces: list[tuple[Chain, int, int, int, int]] = []
    for chain in web.chains.values():
        breaks = corner_indices(chain.cells, room_along(chain, radius)).tolist()
        ids = [numbers[chain.a]]
        for index in breaks:
            ids.append(len(result.nodes) + 1)
            row, col = chain.cells[index].tolist()
            result.put_node(
                node_of(ids[-1], NodeKind.CORNER, (row, col), int(chain.squared[index]), frame)
            )
        ids.append(numbers[chain.b])
        stops = [0, *breaks, len(chain.cells) - 1]
        pieces += [
            (chain, *part) for part in zip(stops[:-1], stops[1:], ids[:-1], ids[1:], strict=True)
        ]
    for number, (chain, first, last, a, b) in enumerate(pieces, len(result.nodes) + 1):
        result.put_edge(edge_of(number, a, b, chain.part(first, last), frame))
    return result


def kind_of(web: Web, spot: int) -> NodeKind:
    """End with one chain or none, branch with three or more.

    The one spot of a ring is a corner of it.
    """
    degree = web.degree(spot)
    if degree < 2:
        return NodeKind.END
    return NodeKind.CORNER if degree == 2 else NodeKind.BRANCH


def node_of(
    number: int, kind: NodeKind, cell: tuple[int, int], squared: int, frame: GridFrame
) -> Node:
    """Node at the centre of a cell."""
    x = frame.origin_x + (cell[1] + 0.5) * frame.resolution
    y = frame.origin_y + (cell[0] + 0.5) * frame.resolution
    return Node(number, kind, x, y, math.sqrt(squared) * frame.resolution)


def edge_of(number: int, a: int, b: int, piece: Chain, frame: GridFrame) -> Edge:
    """Edge from node a to node b along a piece of chain."""
    clearance = math.sqrt(int(piece.squared.min())) * frame.resolution
    return Edge(
        number, a, b, frame.centres_of(piece.cells), piece.length * frame.resolution, clearance
    )
