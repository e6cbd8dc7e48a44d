"""What may be simplified in a skeleton: close branches drawn together, the branches of noise dropped."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.jit import inlined, kernel
from thinmap_ros.core.topology.config import TopologyConfig
from thinmap_ros.core.topology.net import (
    COL,
    COUNT,
    DEGREE,
    DONE,
    NONE,
    ROW,
    SQUARED,
    START,
    A,
    B,
    Net,
    add_last,
    append_cells,
    chain_count,
    change,
    dissolve_all,
    drop_chain,
    fits,
    merge,
    state_of,
    whole,
)
from thinmap_ros.core.topology.web import Web

Cells = NDArray[np.int64]
Mask = NDArray[np.bool_]
_LOOKS_OUT = 3  # cells at the rim of the known that make a spot look out
_FARTHER = 1.0  # cells beyond the clearance in which they lie


class Limits(NamedTuple):
    """The lengths of a TopologyConfig in cells of some grid."""

    radius: float
    spur: float
    spur_ratio: float
    join: float

    @staticmethod
    def of(config: TopologyConfig, resolution: float) -> 'Limits':
        """Limits on a grid of some m a cell."""
        lengths = config.robot_radius_m / resolution, config.spur_m / resolution
        return Limits(*lengths, config.spur_ratio, config.join_m / resolution)


class Outlook(NamedTuple):
    """Where the known borders on the unknown: cells (H, W), the first of which lies at (row, col)."""

    rim: Mask
    row: int
    col: int

    @staticmethod
    def of(known: Mask, occupied: Mask, rim_is_unknown: bool) -> 'Outlook':
        """Outlook over free and occupied cells (H, W); rim_is_unknown: what lies outside the array."""
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


def simplify(web: Web, spots: set[int], outlook: Outlook, limits: Limits) -> None:
    """Round some spots of a web: draw close branches together, drop those of noise, join what then needs no node."""
    change(web, spots, lambda net, chosen: simplify_net(net, chosen, outlook, limits))


@kernel
def simplify_net(net: Net, chosen: Mask, outlook: Outlook, limits: Limits) -> None:
    """The same round some spots (S,) of a net; its state says whether it came to the end."""
    dissolve_all(net, chosen)
    while state_of(net) == DONE and _drop_spurs(net, chosen, outlook, limits):
        pass
    if state_of(net) == DONE:
        _merge_close(net, chosen, limits.join)
    if state_of(net) == DONE:
        _drop_hollow(net, chosen, limits.radius)
        dissolve_all(net, chosen)
        _move_rings(net, chosen)


@inlined
def _is_among(net: Net, number: int, chosen: Mask) -> bool:
    """Whether a chain is there and has an end among some spots (S,)."""
    a = net.chains[number, A]
    return bool(a != NONE and (chosen[a] or chosen[net.chains[number, B]]))


@kernel
def _length(net: Net, number: int) -> float:
    """Length of a chain along its cells, in cells."""
    length, start = 0.0, net.chains[number, START]
    for k in range(start + 1, start + net.chains[number, COUNT]):
        length += math.hypot(net.cells[k, 0] - net.cells[k - 1, 0], net.cells[k, 1] - net.cells[k - 1, 1])
    return length


@kernel
def _merge_close(net: Net, chosen: Mask, limit: float) -> None:
    """Make one branch of two that are joined by a short chain, shortest first; the roomier place stays."""
    numbers = np.empty(chain_count(net), dtype=np.int64)
    lengths = np.empty(numbers.size)
    count = 0
    for number in range(numbers.size):
        if _is_among(net, number, chosen) and net.chains[number, COUNT] <= limit + 1.0:
            numbers[count], lengths[count] = number, _length(net, number)
            count += 1
    for k in np.argsort(lengths[:count], kind='mergesort'):
        a, b = net.chains[numbers[k], A], net.chains[numbers[k], B]
        if a in (NONE, b) or lengths[k] > limit:
            continue
        if net.spots[a, DEGREE] >= 3 and net.spots[b, DEGREE] >= 3:
            merge(net, numbers[k], a if net.spots[a, SQUARED] >= net.spots[b, SQUARED] else b)
            if state_of(net) != DONE:
                return


@kernel
def _drop_hollow(net: Net, chosen: Mask, radius: float) -> None:
    """Drop what closes a ring round nothing; of chains side by side the shortest stays.

    A ring keeps the robot's radius from what it goes round, so it encloses a disc of that radius at least. What
    encloses less is left over from sewing and from drawing branches together: a way there and back, or one way twice.
    """
    # Cells lie up to half a cell beside the true ring; round a single cell goes a ring of area 2.
    least = max(math.pi * (radius - 0.5) ** 2, 1.0)
    beside = np.empty(chain_count(net), dtype=np.int64)
    for number in range(beside.size):
        if not _is_among(net, number, chosen):
            continue
        a, b = net.chains[number, A], net.chains[number, B]
        count = _side_by_side(net, a if chosen[a] else b, b if chosen[a] else a, beside)
        # Once for all that lie side by side, and most chains are alone.
        if beside[0] == number and (count > 1 or a == b):
            _drop_narrow(net, beside[:count], least)


@kernel
def _side_by_side(net: Net, spot: int, other: int, found: Cells) -> int:
    """Write down the numbers of the chains between two spots, in order, each once; returns how many."""
    count, end = 0, net.hooks[spot, 0]
    while end != NONE:
        number = end // 2
        if net.chains[number, 1 - end % 2] == other and (count == 0 or found[count - 1] != number):
            found[count] = number
            count += 1
        end = net.ends[end, 1]
    return count


@kernel
def _drop_narrow(net: Net, numbers: Cells, least: float) -> None:
    """Of chains (N,) between the same two spots, shortest first, drop each that encloses too little with one kept."""
    lengths = np.array([_length(net, number) for number in numbers])
    twice = np.array([_twice_area(net, number) for number in numbers])
    kept = np.empty(numbers.size, dtype=np.int64)
    count = 0
    for k in np.argsort(lengths, kind='mergesort'):
        a, b = net.chains[numbers[k], A], net.chains[numbers[k], B]
        narrow = a == b and abs(twice[k]) / 2.0 < least
        for i in kept[:count]:
            back = twice[i] if net.chains[numbers[i], A] == b else -twice[i]
            narrow |= a != b and abs(twice[k] + back) / 2.0 < least
        if narrow:
            drop_chain(net, numbers[k])
        else:
            kept[count] = k
            count += 1


@kernel
def _twice_area(net: Net, number: int) -> int:
    """Twice the area, in cells, that a chain sweeps as seen from the lattice's first cell: Gauss's shoelace formula."""
    twice, start = 0, net.chains[number, START]
    for k in range(start, start + net.chains[number, COUNT] - 1):
        twice += net.cells[k, 0] * net.cells[k + 1, 1] - net.cells[k, 1] * net.cells[k + 1, 0]
    return twice


@kernel
def _drop_spurs(net: Net, chosen: Mask, outlook: Outlook, limits: Limits) -> bool:
    """One round of pruning; whether anything was dropped.

    A spur is a chain with one free end. What it adds to the place where it begins is the length by which the space
    round its tip reaches beyond the space round its base: length + room(tip) - room(base), room being clearance less
    robot radius. Up to spur_m that is noise; and where the tip looks at known walls only, up to spur_ratio of the
    base's room too (a right-angled corner of a room adds 0.41 of it). So is one that lies in the room round other
    chains from its base altogether: what is left where an old piece of skeleton runs beside a new one. All spurs of a
    round go together, so that the two corners at the end of a corridor leave its middle as the end.
    """
    gone = np.empty(chain_count(net), dtype=np.int64)
    tips, bases = np.empty(gone.size, dtype=np.int64), np.zeros(chosen.size, dtype=np.bool_)
    count = 0
    for number in range(gone.size):
        tip = _tip(net, number) if _is_among(net, number, chosen) else NONE
        if tip == NONE:
            continue
        base = net.chains[number, A] + net.chains[number, B] - tip
        is_noise = _adds_little(net, number, tip, base, outlook, limits)
        if not is_noise and (count > 0 or not _adds_nothing(net, number, base, limits.radius)):
            continue
        gone[count], tips[count], bases[base] = number, tip, True
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
    a, b = net.chains[number, A], net.chains[number, B]
    free_a, free_b = net.spots[a, DEGREE] == 1, net.spots[b, DEGREE] == 1
    if free_a and free_b:
        return int(a if net.spots[a, SQUARED] <= net.spots[b, SQUARED] else b)
    return int(a if free_a else b if free_b else NONE)


@kernel
def _adds_little(net: Net, number: int, tip: int, base: int, outlook: Outlook, limits: Limits) -> bool:
    """Whether a spur brings the robot hardly any farther than its base does."""
    tip_room = math.sqrt(net.spots[tip, SQUARED]) - limits.radius
    base_room = math.sqrt(net.spots[base, SQUARED]) - limits.radius
    adds = _length(net, number) + tip_room - base_room
    if adds <= limits.spur:
        return True
    return adds <= limits.spur_ratio * base_room and not _looks_out(outlook, net.spots[tip])


@kernel
def _looks_out(outlook: Outlook, spot: Cells) -> bool:
    """Whether the free space round a spot borders on the unknown: its clearance ends there and not at an obstacle.

    Nobody knows that of a spot outside the cells: it may.
    """
    row, col = spot[ROW] - outlook.row, spot[COL] - outlook.col
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
    """Whether a spur lies in the room round other chains, those at its base and at the next spots, altogether."""
    others = _others_near(net, number, base)
    start, count = net.chains[number, START], net.chains[number, COUNT]
    # From the tip on: that is where most spurs stand out.
    from_a = net.chains[number, A] != base
    for k in range(count):
        if not _is_held(net, net.cells[start + (k if from_a else count - 1 - k)], others, radius):
            return False
    return others.size > 0


@kernel
def _others_near(net: Net, number: int, base: int) -> Cells:
    """Numbers (N,) of the chains at a spot and at the next ones, but for one; none where not all are known."""
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
            row, col = cell[0] - net.cells[k, 0], cell[1] - net.cells[k, 1]
            # Most are too far off for any radius.
            if row * row + col * col > net.cells[k, 2]:
                continue
            room = math.sqrt(net.cells[k, 2]) - radius
            if room >= 0.0 and row * row + col * col <= room * room:
                return True
    return False


@kernel
def _move_rings(net: Net, chosen: Mask) -> None:
    """Put the one node of each ring at the ring's cell that is farthest from its middle, wherever tracing began."""
    for number in range(chain_count(net)):
        if state_of(net) != DONE or not _is_among(net, number, chosen):
            continue
        spot, start, count = net.chains[number, A], net.chains[number, START], net.chains[number, COUNT]
        if spot != net.chains[number, B] or net.spots[spot, DEGREE] != 2 or not fits(net, count):
            continue
        first = _farthest_out(net.cells[start : start + count])
        net.spots[spot, :3] = net.cells[start + first]
        append_cells(net, start + first, count - first, False, 0)
        append_cells(net, start, first + 1, False, 1)
        drop_chain(net, number)
        add_last(net, spot, spot, count)


@kernel
def _farthest_out(ring: Cells) -> int:
    """Index of the cell of a ring (K, 3), its last the same as its first, farthest from its middle, or nearly so.

    Of all that are as far within two cells the first in reading order, so that it does not jump.
    """
    middle_row = (ring[:, 0].min() + ring[:, 0].max()) / 2.0
    middle_col = (ring[:, 1].min() + ring[:, 1].max()) / 2.0
    distance = np.hypot(ring[:-1, 0] - middle_row, ring[:-1, 1] - middle_col)
    limit, best = distance.max() - 2.0, NONE
    for k in range(distance.size):
        if distance[k] < limit:
            continue
        earlier = ring[k, 0] < ring[best, 0] or (ring[k, 0] == ring[best, 0] and ring[k, 1] < ring[best, 1])
        if best == NONE or earlier:
            best = k
    return best
