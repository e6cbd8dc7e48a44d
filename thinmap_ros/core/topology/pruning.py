"""Spurs of a skeleton: which of its branches only noise made."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.jit import kernel
from thinmap_ros.core.topology.config import TopologyConfig
from thinmap_ros.core.topology.net import (
    COL,
    COUNT,
    DEGREE,
    NONE,
    ROW,
    SQUARED,
    START,
    A,
    B,
    Net,
    chain_count,
    dissolve_all,
    drop_chain,
    is_among,
    length_of,
    whole,
)

Cells = NDArray[np.int64]
Mask = NDArray[np.bool_]
_LOOKS_OUT = 3  # cells at the rim of the known that make a spot look out
_FARTHER = 1.0  # cells beyond the clearance in which they lie


class Limits(NamedTuple):
    """The lengths of a TopologyConfig in cells of some grid."""

    radius: float
    spur: float
    min_branch_ratio: float
    join: float

    @staticmethod
    def of(config: TopologyConfig, resolution: float) -> 'Limits':
        """Limits on a grid of some m a cell."""
        lengths = config.robot_radius_m / resolution, config.min_branch_length_m / resolution
        return Limits(
            *lengths, config.min_branch_ratio, config.branch_merge_distance_m / resolution
        )


class Outlook(NamedTuple):
    """Where the known borders on the unknown.

    Cells (H, W), the first of which lies at (row, col).
    """

    rim: Mask
    row: int
    col: int

    @staticmethod
    def of(known: Mask, occupied: Mask, rim_is_unknown: bool) -> 'Outlook':
        """Outlook over free and occupied cells (H, W).

        rim_is_unknown: what lies outside the array.
        """
        return Outlook(_frontier(known, occupied, rim_is_unknown), 0, 0)

    def at(self, row: int, col: int) -> 'Outlook':
        """The same with the first cell at another place."""
        return Outlook(self.rim, row, col)


@kernel
def _frontier(known: Mask, occupied: Mask, rim_is_unknown: bool) -> Mask:
    """Free cells (H, W) with an unknown one beside them."""
    rows, cols = known.shape
    unknown = np.full((rows + 2, cols + 2), rim_is_unknown)
    for row in range(rows):
        for col in range(cols):
            unknown[row + 1, col + 1] = not (known[row, col] | occupied[row, col])
    frontier = np.empty((rows, cols), dtype=np.bool_)
    for row in range(rows):
        for col in range(cols):
            beside = unknown[row, col + 1] | unknown[row + 2, col + 1]
            beside |= unknown[row + 1, col] | unknown[row + 1, col + 2]
            frontier[row, col] = known[row, col] & beside
    return frontier


@kernel
def drop_spurs(net: Net, chosen: Mask, outlook: Outlook, limits: Limits) -> bool:
    """One round of pruning; whether anything was dropped.

    A spur is a chain with one free end. What it adds to the place where it begins is the length by
    which the space round its tip reaches beyond the space round its base: length + room(tip) -
    room(base), room being clearance less robot radius. Up to min_branch_length_m that is noise; and
    where the tip looks at known walls only, up to min_branch_ratio of the base's room too (a
    right-angled corner of a room adds 0.41 of it). So is one that lies in the room round other
    chains from its base altogether: what is left where an old piece of skeleton runs beside a new
    one. All spurs of a round go together, so that the two corners at the end of a corridor leave
    its middle as the end.
    """
    gone = np.empty(chain_count(net), dtype=np.int64)
    tips = np.empty(gone.size, dtype=np.int64)
    bases = np.zeros(chosen.size, dtype=np.bool_)
    count = 0
    for number in range(gone.size):
        tip = _tip(net, number) if is_among(net, number, chosen) else NONE
        if tip == NONE:
            continue
        base = net.chains[number, A] + net.chains[number, B] - tip
        is_noise = _adds_little(net, number, tip, base, outlook, limits)
        if not is_noise and (count > 0 or not _adds_nothing(net, number, base, limits.radius)):
            continue
        gone[count] = number
        tips[count] = tip
        bases[base] = True
        count += 1
        if not is_noise:
            break
    for k in range(count):
        drop_chain(net, gone[k])
        net.spots[tips[k], DEGREE] = NONE
    dissolve_all(net, bases)
    return count > 0


@kernel
def _tip(net: Net, number: int) -> int:
    """The free end of a chain; of two free ends the one with less room; NONE without any."""
    a = net.chains[number, A]
    b = net.chains[number, B]
    free_a = net.spots[a, DEGREE] == 1
    free_b = net.spots[b, DEGREE] == 1
    if free_a and free_b:
        return int(a if net.spots[a, SQUARED] <= net.spots[b, SQUARED] else b)
    return int(a if free_a else b if free_b else NONE)


@kernel
def _adds_little(
    net: Net, number: int, tip: int, base: int, outlook: Outlook, limits: Limits
) -> bool:
    """Whether a spur brings the robot hardly any farther than its base does."""
    tip_room = math.sqrt(net.spots[tip, SQUARED]) - limits.radius
    base_room = math.sqrt(net.spots[base, SQUARED]) - limits.radius
    adds = length_of(net, number) + tip_room - base_room
    if adds <= limits.spur:
        return True
    return adds <= limits.min_branch_ratio * base_room and not _looks_out(outlook, net.spots[tip])


@kernel
def _looks_out(outlook: Outlook, spot: Cells) -> bool:
    """Whether the free space round a spot borders on the unknown.

    Its clearance ends there and not at an obstacle.

    Nobody knows that of a spot outside the cells: it may.
    """
    row = spot[ROW] - outlook.row
    col = spot[COL] - outlook.col
    rows, cols = outlook.rim.shape
    if not (0 <= row < rows and 0 <= col < cols):
        return True
    reach = math.sqrt(spot[SQUARED]) + _FARTHER
    count = 0
    for r in range(max(math.ceil(row - reach), 0), min(int(row + reach) + 1, rows)):
        for c in range(max(math.ceil(col - reach), 0), min(int(col + reach) + 1, cols)):
            count += outlook.rim[r, c] and (r - row) ** 2 + (c - col) ** 2 <= reach**2
    return count >= _LOOKS_OUT


@kernel
def _adds_nothing(net: Net, number: int, base: int, radius: float) -> bool:
    """Whether a spur lies wholly in the room round other chains at its base and the next spots."""
    others = _others_near(net, number, base)
    start = net.chains[number, START]
    count = net.chains[number, COUNT]
    # From the tip on: that is where most spurs stand out.
    from_a = net.chains[number, A] != base
    for k in range(count):
        if not _is_held(net, net.cells[start + (k if from_a else count - 1 - k)], others, radius):
            return False
    return others.size > 0


@kernel
def _others_near(net: Net, number: int, base: int) -> Cells:
    """Numbers (N,) of the chains at a spot and at the next ones, but for one.

    None where not all are known.
    """
    found = np.empty(chain_count(net), dtype=np.int64)
    taken = np.zeros(found.size, dtype=np.bool_)
    taken[number] = True
    count = 0
    first = net.hooks[base, 0] if whole(net, base) else NONE
    while first != NONE:
        for side in range(2):
            spot = net.chains[first // 2, side]
            end = net.hooks[spot, 0] if whole(net, spot) else NONE
            while end != NONE:
                if not taken[end // 2]:
                    taken[end // 2] = True
                    found[count] = end // 2
                    count += 1
                end = net.ends[end, 1]
        first = net.ends[first, 1]
    return found[:count]


@kernel
def _is_held(net: Net, cell: Cells, numbers: Cells, radius: float) -> bool:
    """Whether a cell lies in the room round one of the cells of some chains (N,)."""
    for number in numbers:
        start = net.chains[number, START]
        for k in range(start, start + net.chains[number, COUNT]):
            row = cell[0] - net.cells[k, 0]
            col = cell[1] - net.cells[k, 1]
            # Most are too far off for any radius.
            if row * row + col * col > net.cells[k, 2]:
                continue
            room = math.sqrt(net.cells[k, 2]) - radius
            if room >= 0.0 and row * row + col * col <= room * room:
                return True
    return False
