"""Poses within the uncertainty of the motion, by what the beams of a scan would meet at them.

Source: Olson, "Real-time correlative scan matching", 2009.
"""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.tiles import NO_TILE, TILE
from thinmap_ros.core.jit import inlined, kernel
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.least_squares import (
    RELIABLE_HITS,
    USUAL_LOSS,
    is_seen,
    loss,
    quadratic,
    tempered,
)
from thinmap_ros.core.slam.local_map import HERE, Lattice, cell_distance, cell_of, slot_of

UNSEEN = 0.5  # cost of a point where nobody has looked yet, for one in the open
_MASK = TILE - 1


@inlined
def _is_crossed(lattice: Lattice, x0: float, y0: float, x1: float, y1: float) -> bool:
    """Whether a beam from (x0, y0) to (x1, y1), in cells, crosses a wall well before its end."""
    length = math.hypot(x1 - x0, y1 - y0)
    for k in range(1, int(length) - lattice.reach):
        along = k / length
        row, col = cell_of(y0 + along * (y1 - y0)), cell_of(x0 + along * (x1 - x0))
        slot = slot_of(lattice, row, col)
        if slot != NO_TILE:
            cell = lattice.pool[slot, row & _MASK, col & _MASK]
            if cell['to_row'] == HERE and cell['to_col'] == HERE and cell['hits'] >= RELIABLE_HITS:
                return True
    return False


@inlined
def _end_cost(
    lattice: Lattice, row: int, col: int, sigma: float, width: float, unseen: float
) -> float:
    """Cost of a beam that ends in a cell.

    Where nobody has looked yet it costs less than in the open: ahead of a robot that moves there
    are such ends, and a pose farther back, where there are none, would seem the likelier.
    """
    error = cell_distance(lattice, row, col) / sigma
    cost = loss(error * error, width)
    if error >= lattice.reach / sigma and not is_seen(lattice, row, col):
        cost *= unseen
    return cost


@kernel
def beam_cost(
    scan: Array, laser: Array, pose: Array, lattice: Lattice, sigma: float, width: float
) -> float:
    """Cost of the beams of a scan at a pose: their ends, and the walls that they would cross."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    cell_m, reach = lattice.cell_m, float(lattice.reach)
    x0 = (pose[0] + cos * laser[0] - sin * laser[1]) / cell_m - lattice.first_col
    y0 = (pose[1] + sin * laser[0] + cos * laser[1]) / cell_m - lattice.first_row
    gross = loss((reach / sigma) ** 2, width)
    cost = 0.0
    for i in range(len(scan)):
        x1 = (pose[0] + cos * scan[i, 0] - sin * scan[i, 1]) / cell_m - lattice.first_col
        y1 = (pose[1] + sin * scan[i, 0] + cos * scan[i, 1]) / cell_m - lattice.first_row
        if _is_crossed(lattice, x0, y0, x1, y1):
            cost += scan[i, 2] * gross
        else:
            row, col = cell_of(y1), cell_of(x1)
            cost += scan[i, 2] * _end_cost(lattice, row, col, sigma, width, UNSEEN)
    return tempered(cost, scan[:, 2].sum())


@inlined
def _outwards(n: int) -> int:
    """0, 1, -1, 2, -2 and so on."""
    return (n + 1) // 2 if n % 2 else -(n // 2)


@inlined
def _note_cells(
    scan: Array,
    prior: Array,
    turn: float,
    lattice: Lattice,
    corner_row: int,
    corner_col: int,
    at: NDArray[np.int64],
) -> None:
    """Put the cells (N, 2) of a scan that is turned at a prior into `at`, counted from a corner."""
    cell_m = lattice.cell_m
    cos, sin = math.cos(prior[2] + turn), math.sin(prior[2] + turn)
    for i in range(len(scan)):
        x = prior[0] + cos * scan[i, 0] - sin * scan[i, 1]
        y = prior[1] + sin * scan[i, 0] + cos * scan[i, 1]
        at[i, 0] = cell_of(y / cell_m) - lattice.first_row - corner_row
        at[i, 1] = cell_of(x / cell_m) - lattice.first_col - corner_col


@kernel
def searched(
    scan: Array,
    prior: Array,
    steps: NDArray[np.int64],
    sizes: Array,
    by_prior: Array,
    lattice: Lattice,
    sigma: float,
    width: float,
    slipped: float,
    unseen: float,
) -> Array:
    """The pose (3,) of a lattice round a prior with the lowest sum."""
    cell_m = lattice.cell_m
    stride = int(round(sizes[0] / cell_m))
    # Cost of every cell in sight, once it is asked for.
    rim = int(np.hypot(scan[:, 0], scan[:, 1]).max() / cell_m) + 4 + stride * steps[:2].max()
    corner_row = cell_of(prior[1] / cell_m) - lattice.first_row - rim
    corner_col = cell_of(prior[0] / cell_m) - lattice.first_col - rim
    costs = np.full((2 * rim + 1, 2 * rim + 1), np.float32(-1.0))
    best = prior.copy()
    usual = USUAL_LOSS * scan[:, 2].sum()
    lowest = 700.0 * usual
    at = np.empty((len(scan), 2), dtype=np.int64)
    # From the prior outwards: a low sum that is found early spares the most of the others.
    for k in range(2 * steps[2] + 1):
        turn = _outwards(k) * sizes[1]
        _note_cells(scan, prior, turn, lattice, corner_row, corner_col, at)
        for i in range(2 * steps[1] + 1):
            for j in range(2 * steps[0] + 1):
                a, b = _outwards(i), _outwards(j)
                dx, dy = b * sizes[0], a * sizes[0]
                by_motion = loss(quadratic(by_prior, dx, dy, turn), slipped)
                if by_motion >= lowest:
                    continue
                most = usual * math.expm1((lowest - by_motion) / usual)
                cost = 0.0
                for p in range(len(scan)):
                    r, c = at[p, 0] + stride * a, at[p, 1] + stride * b
                    if costs[r, c] < 0.0:
                        row, col = r + corner_row, c + corner_col
                        end = _end_cost(lattice, row, col, sigma, width, unseen)
                        costs[r, c] = np.float32(end)
                    cost += scan[p, 2] * costs[r, c]
                    if cost >= most:
                        break
                if cost < most:
                    lowest = by_motion + usual * math.log1p(cost / usual)
                    best[0], best[1], best[2] = prior[0] + dx, prior[1] + dy, prior[2] + turn
    return best
