"""Global pose search by branch and bound within the uncertainty of a prior.

Source: Olson, "Real-time correlative scan matching", 2009; Hess et al., "Real-time loop closure in
2D LIDAR SLAM", 2016, for branch and bound. The lower bound of a node follows from the distances to
the nearest walls: a displacement changes a distance by at most its length. A point out of reach of
any wall is assumed to stay out of reach.
"""

import heapq
import math

import numpy as np

from thinmap_ros.core.grid.tiles import NO_TILE, TILE
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.matching.local_map import LocalMapView, cell_of, cells_to_wall, slot_of
from thinmap_ros.core.slam.matching.matching_cost import (
    SLIP_SIGMAS,
    UNSEEN_COST,
    by_prior,
    far_cost,
    loss,
)
from thinmap_ros.jit import inlined, kernel

_ROOT = 4.0  # half the size of a root node, in cells
_LEVELS = 2  # levels of nodes below the root
_DIAGONAL = 1.4  # largest translation within a node, per half of its size
_MASK = TILE - 1


@inlined
def _cost(
    scan: Array,
    pose: Array | tuple[float, float, float],
    lattice: LocalMapView,
    sigma: float,
    width: float,
    slack: float,
    most: float,
) -> float:
    """Cost of a scan at a pose, with wall distances reduced by a slack, in cells.

    scan (N, 4): x, y, weight, and the factor of the slack. Returns early when the cost exceeds
    `most`.
    """
    scale = lattice.cell_m / sigma
    far = far_cost(lattice, sigma, width)
    cos = math.cos(pose[2])
    sin = math.sin(pose[2])
    cost = 0.0
    for i in range(len(scan)):
        x = pose[0] + cos * scan[i, 0] - sin * scan[i, 1]
        y = pose[1] + sin * scan[i, 0] + cos * scan[i, 1]
        row = cell_of(y / lattice.cell_m) - lattice.first_row
        col = cell_of(x / lattice.cell_m) - lattice.first_col
        slot = slot_of(lattice, row, col)
        share = UNSEEN_COST
        away = np.inf
        if slot != NO_TILE:
            cell = lattice.pool[slot, row & _MASK, col & _MASK]
            share = 1.0 if cell['seen'] > 0 else UNSEEN_COST
            away = cells_to_wall(cell)
        nearest = (away - slack * scan[i, 3]) * scale
        if away == np.inf:
            cost += scan[i, 2] * share * far
        elif nearest > 0.0:
            cost += scan[i, 2] * loss(nearest * nearest, width)
        if cost >= most:
            break
    return cost


@inlined
def _least_by_prior(
    middle: tuple[float, float, float], half: tuple[float, float, float], information: Array
) -> float:
    """Lower bound of the prior's cost in a node: at the point nearest to the prior on each axis.

    middle: centre of the node relative to the prior; half: of its size. Numbers, not arrays: there
    are thousands of nodes, and an array would take longer than all that is done with it.
    """
    x = math.copysign(max(abs(middle[0]) - half[0], 0.0), middle[0])
    y = math.copysign(max(abs(middle[1]) - half[1], 0.0), middle[1])
    turn = math.copysign(max(abs(middle[2]) - half[2], 0.0), middle[2])
    squared = information[0, 0] * x * x + information[1, 1] * y * y
    squared += information[2, 2] * turn * turn + 2.0 * information[0, 1] * x * y
    squared += 2.0 * (information[0, 2] * x + information[1, 2] * y) * turn
    return loss(squared, SLIP_SIGMAS)


@kernel
def search(
    scan: Array,
    prior: Array,
    information: Array,
    half: Array,
    incumbent: Array,
    lattice: LocalMapView,
    sigma: float,
    width: float,
    most_nodes: int,
) -> Array:
    """Pose (3,) of lowest cost around a prior (3,), or the incumbent (3,) if none is lower.

    scan (N, 3): x, y, weight; half (3,): half of the search window, m, m, rad, rounded to whole
    root nodes; information (3, 3) of the prior; sigma, width: as in `evaluate`.
    """
    away = np.sqrt(scan[:, 0] ** 2 + scan[:, 1] ** 2)
    radius = max(np.median(away), 1.0)
    moving = np.empty((len(scan), 4))
    moving[:, :3] = scan
    for i in range(len(scan)):
        moving[i, 3] = _DIAGONAL + away[i] / radius
    size = np.array([1.0, 1.0, 1.0 / radius]) * _ROOT * lattice.cell_m
    best = incumbent.copy()
    _, _, cost = by_prior(best, prior, information)
    lowest = cost + _cost(moving, best, lattice, sigma, width, 0.0, np.inf)
    counts = [int(half[k] / (2.0 * size[k]) + 0.5) for k in range(3)]
    children = [
        (0, 2.0 * size[0] * i, 2.0 * size[1] * j, 2.0 * size[2] * m)
        for i in range(-counts[0], counts[0] + 1)
        for j in range(-counts[1], counts[1] + 1)
        for m in range(-counts[2], counts[2] + 1)
    ]
    spent = -len(children)
    heap = [(0.0, 0, 0.0, 0.0, 0.0) for _ in range(0)]
    while True:
        spent += len(children)
        for level, dx, dy, turn in children:
            share = 0.5**level if level < _LEVELS else 0.0  # a leaf is a single pose
            half_size = (share * size[0], share * size[1], share * size[2])
            pose = (prior[0] + dx, prior[1] + dy, prior[2] + turn)
            cost = _least_by_prior((dx, dy, turn), half_size, information)
            if cost < lowest:
                slack = _ROOT * share
                cost += _cost(moving, pose, lattice, sigma, width, slack, lowest - cost)
            if cost < lowest and level < _LEVELS:
                heapq.heappush(heap, (cost, level, dx, dy, turn))
            elif cost < lowest:
                lowest = cost
                best = np.array(pose)
        if len(heap) == 0 or spent > most_nodes:
            break
        bound, level, dx, dy, turn = heapq.heappop(heap)
        if bound >= lowest:
            break
        part = 0.5 ** (level + 1) * size
        children = [
            (level + 1, dx + a * part[0], dy + b * part[1], turn + c * part[2])
            for a in (-1, 1)
            for b in (-1, 1)
            for c in (-1, 1)
        ]
    return best
