"""What may be simplified in a skeleton.

Close branches drawn together, the branches of noise dropped.
"""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.jit import kernel
from thinmap_ros.core.topology.net import (
    COUNT,
    DEGREE,
    DONE,
    NONE,
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
    is_among,
    length_of,
    merge,
    state_of,
)
from thinmap_ros.core.topology.pruning import Limits, Outlook, drop_spurs
from thinmap_ros.core.topology.skeleton_graph import Web

Cells = NDArray[np.int64]
Mask = NDArray[np.bool_]


def simplify(web: Web, spots: set[int], outlook: Outlook, limits: Limits) -> None:
    """Round some spots of a web.

    Draw close branches together, drop those of noise, join what then needs no node.
    """
    change(web, spots, lambda net, chosen: simplify_net(net, chosen, outlook, limits))


@kernel
def simplify_net(net: Net, chosen: Mask, outlook: Outlook, limits: Limits) -> None:
    """The same round some spots (S,) of a net; its state says whether it came to the end."""
    dissolve_all(net, chosen)
    while state_of(net) == DONE and drop_spurs(net, chosen, outlook, limits):
        pass
    if state_of(net) == DONE:
        _merge_close(net, chosen, limits.join)
    if state_of(net) == DONE:
        _drop_hollow(net, chosen, limits.radius)
        dissolve_all(net, chosen)
        _move_rings(net, chosen)


@kernel
def _merge_close(net: Net, chosen: Mask, limit: float) -> None:
    """Make one branch of two that are joined by a short chain, shortest first.

    The roomier place stays.
    """
    numbers = np.empty(chain_count(net), dtype=np.int64)
    lengths = np.empty(numbers.size)
    count = 0
    for number in range(numbers.size):
        if is_among(net, number, chosen) and net.chains[number, COUNT] <= limit + 1.0:
            numbers[count] = number
            lengths[count] = length_of(net, number)
            count += 1
    for k in np.argsort(lengths[:count], kind='mergesort'):
        a = net.chains[numbers[k], A]
        b = net.chains[numbers[k], B]
        if a in (NONE, b) or lengths[k] > limit:
            continue
        if net.spots[a, DEGREE] >= 3 and net.spots[b, DEGREE] >= 3:
            merge(net, numbers[k], a if net.spots[a, SQUARED] >= net.spots[b, SQUARED] else b)
            if state_of(net) != DONE:
                return


@kernel
def _drop_hollow(net: Net, chosen: Mask, radius: float) -> None:
    """Drop what closes a ring round nothing; of chains side by side the shortest stays.

    A ring keeps the robot's radius from what it goes round, so it encloses a disc of that radius at
    least. What encloses less is left over from sewing and from drawing branches together: a way
    there and back, or one way twice.
    """
    # Cells lie up to half a cell beside the true ring; round a single cell goes a ring of area 2.
    least = max(math.pi * (radius - 0.5) ** 2, 1.0)
    beside = np.empty(chain_count(net), dtype=np.int64)
    for number in range(beside.size):
        if not is_among(net, number, chosen):
            continue
        a = net.chains[number, A]
        b = net.chains[number, B]
        count = _side_by_side(net, a if chosen[a] else b, b if chosen[a] else a, beside)
        # Once for all that lie side by side, and most chains are alone.
        if beside[0] == number and (count > 1 or a == b):
            _drop_narrow(net, beside[:count], least)


@kernel
def _side_by_side(net: Net, spot: int, other: int, found: Cells) -> int:
    """Write down the numbers of the chains between two spots, in order, each once.

    Returns how many.
    """
    count = 0
    end = net.hooks[spot, 0]
    while end != NONE:
        number = end // 2
        if net.chains[number, 1 - end % 2] == other and (count == 0 or found[count - 1] != number):
            found[count] = number
            count += 1
        end = net.ends[end, 1]
    return count


@kernel
def _drop_narrow(net: Net, numbers: Cells, least: float) -> None:
    """Drop chains (N,), shortest first, that enclose too little with one that is kept.

    All of them lie between the same two spots.
    """
    lengths = np.array([length_of(net, number) for number in numbers])
    twice = np.array([_twice_area(net, number) for number in numbers])
    kept = np.empty(numbers.size, dtype=np.int64)
    count = 0
    for k in np.argsort(lengths, kind='mergesort'):
        a = net.chains[numbers[k], A]
        b = net.chains[numbers[k], B]
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
    """Twice the area, in cells, that a chain sweeps as seen from the lattice's first cell.

    Gauss's shoelace formula.
    """
    twice = 0
    start = net.chains[number, START]
    for k in range(start, start + net.chains[number, COUNT] - 1):
        twice += net.cells[k, 0] * net.cells[k + 1, 1] - net.cells[k, 1] * net.cells[k + 1, 0]
    return twice


@kernel
def _move_rings(net: Net, chosen: Mask) -> None:
    """Put the one node of each ring at its cell farthest from its middle, however it was traced."""
    for number in range(chain_count(net)):
        if state_of(net) != DONE or not is_among(net, number, chosen):
            continue
        spot = net.chains[number, A]
        start = net.chains[number, START]
        count = net.chains[number, COUNT]
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
    """Index of the cell of a ring (K, 3) that is farthest from its middle, or nearly so.

    The ring's last cell is the same as its first. Of all that are as far within two cells the first
    in reading order, so that it does not jump.
    """
    middle_row = (ring[:, 0].min() + ring[:, 0].max()) / 2.0
    middle_col = (ring[:, 1].min() + ring[:, 1].max()) / 2.0
    distance = np.hypot(ring[:-1, 0] - middle_row, ring[:-1, 1] - middle_col)
    limit = distance.max() - 2.0
    best = NONE
    for k in range(distance.size):
        if distance[k] < limit:
            continue
        earlier = ring[k, 0] < ring[best, 0] or (
            ring[k, 0] == ring[best, 0] and ring[k, 1] < ring[best, 1]
        )
        if best == NONE or earlier:
            best = k
    return best
