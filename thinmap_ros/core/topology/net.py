"""Spots and chains as arrays, for compiled code to change.

What `Web` is, without an object for each of them.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.jit import inlined, kernel
from thinmap_ros.core.topology.skeleton_graph import Chain, Spot, Web

Cells = NDArray[np.int64]
Mask = NDArray[np.bool_]
NONE = -1
# Of a spot; squared clearance in cells, chain ends; degree NONE: gone.
ROW = 0
COL = 1
SQUARED = 2
DEGREE = 3
# Of a chain; a NONE: gone
A = 0
B = 1
START = 2
COUNT = 3
# How far one got: to the end, out of room, or past what was put in
DONE = 0
FULL = 1
SHORT = 2
# Of what is used
_CHAINS = 0
_CELLS = 1
_STATE = 2
_REACH = 4  # chains from a spot that are put in at first


class Net(NamedTuple):
    """A web as arrays with room for more. Numbers are given in order, and never again.

    A chain k has two ends, 2 k at its spot a and 2 k + 1 at b. spots (S, 4): row, col, squared
    clearance, degree;
    hooks (S, 2): first and last chain end there; chains (C, 4): a, b, first cell and their count;
    ends (2 C, 2): the chain end before and after each at the same spot, oldest first; cells (P, 3):
    row, col, squared clearance;
    used (3,): chains, cells, state; partial (S,): spots of which not all chains have been put in.
    """

    spots: Cells
    hooks: Cells
    chains: Cells
    ends: Cells
    cells: Cells
    used: Cells
    partial: Mask


def net_of(nodes: Cells, ends: Cells, starts: Cells, cells: Cells, room: int = 1) -> Net:
    """Net of nodes (N, 3) as row, col and squared clearance, and chains between them.

    ends (M, 2): nodes; starts (M + 1,): where in the cells (K, 3) each chain begins; room: for how
    many times as much.
    """
    chains = len(ends) * (1 + room) + 64
    count = len(cells) * (1 + 3 * room) + 4096
    net = Net(
        np.zeros((len(nodes), 4), dtype=np.int64),
        np.full((len(nodes), 2), NONE, dtype=np.int64),
        np.empty((chains, 4), dtype=np.int64),
        np.empty((2 * chains, 2), dtype=np.int64),
        np.empty((count, 3), dtype=np.int64),
        np.zeros(3, dtype=np.int64),
        np.zeros(len(nodes), dtype=np.bool_),
    )
    _fill(net, nodes, ends, starts, cells)
    return net


@kernel
def _fill(net: Net, nodes: Cells, ends: Cells, starts: Cells, cells: Cells) -> None:
    net.spots[:, :3] = nodes
    net.cells[: cells.shape[0]] = cells
    net.used[_CELLS] = cells.shape[0]
    for k in range(ends.shape[0]):
        add_chain(net, ends[k, 0], ends[k, 1], starts[k], starts[k + 1] - starts[k])


@kernel
def state_of(net: Net) -> int:
    """DONE as long as all that was asked could be done."""
    return int(net.used[_STATE])


@kernel
def chain_count(net: Net) -> int:
    """Numbers of chains given so far."""
    return int(net.used[_CHAINS])


@inlined
def is_among(net: Net, number: int, chosen: Mask) -> bool:
    """Whether a chain is there and has an end among some spots (S,)."""
    a = net.chains[number, A]
    return bool(a != NONE and (chosen[a] or chosen[net.chains[number, B]]))


@kernel
def length_of(net: Net, number: int) -> float:
    """Length of a chain along its cells, in cells."""
    length = 0.0
    start = net.chains[number, START]
    for k in range(start + 1, start + net.chains[number, COUNT]):
        length += math.hypot(
            net.cells[k, 0] - net.cells[k - 1, 0], net.cells[k, 1] - net.cells[k - 1, 1]
        )
    return length


@kernel
def whole(net: Net, spot: int) -> bool:
    """Whether all chains at a spot are known; says that something is missing where they are not."""
    if net.partial[spot]:
        net.used[_STATE] = SHORT
    return not net.partial[spot]


@kernel
def fits(net: Net, cells: int) -> bool:
    """Whether there is room for a chain of so many cells; says so where there is none."""
    room = (
        net.used[_CHAINS] < net.chains.shape[0] and net.used[_CELLS] + cells <= net.cells.shape[0]
    )
    if not room:
        net.used[_STATE] = FULL
    return bool(room)


@kernel
def add_chain(net: Net, a: int, b: int, start: int, count: int) -> None:
    """Add a chain between two spots, along cells that are there."""
    number = net.used[_CHAINS]
    net.used[_CHAINS] += 1
    net.chains[number, A] = a
    net.chains[number, B] = b
    net.chains[number, START] = start
    net.chains[number, COUNT] = count
    for side in range(2):
        spot = net.chains[number, side]
        end = 2 * number + side
        last = net.hooks[spot, 1]
        net.ends[end, 0] = last
        net.ends[end, 1] = NONE
        if last == NONE:
            net.hooks[spot, 0] = end
        else:
            net.ends[last, 1] = end
        net.hooks[spot, 1] = end
        net.spots[spot, DEGREE] += 1


@kernel
def drop_chain(net: Net, number: int) -> None:
    """Remove a chain; its spots and cells stay."""
    for side in range(2):
        spot = net.chains[number, side]
        end = 2 * number + side
        before = net.ends[end, 0]
        after = net.ends[end, 1]
        if before == NONE:
            net.hooks[spot, 0] = after
        else:
            net.ends[before, 1] = after
        if after == NONE:
            net.hooks[spot, 1] = before
        else:
            net.ends[after, 0] = before
        net.spots[spot, DEGREE] -= 1
    net.chains[number, A] = NONE


@kernel
def append_cells(net: Net, start: int, count: int, backwards: bool, skip: int) -> None:
    """Put a copy of `count` cells from `start` on after all others, less the first few.

    With `backwards`, of these in reverse order.
    """
    used = net.used[_CELLS]
    for k in range(skip, count):
        net.cells[used + k - skip] = net.cells[start + (count - 1 - k if backwards else k)]
    net.used[_CELLS] += count - skip


@kernel
def add_last(net: Net, a: int, b: int, count: int) -> None:
    """Add a chain between two spots along the newest cells."""
    add_chain(net, a, b, net.used[_CELLS] - count, count)


@kernel
def dissolve(net: Net, spot: int) -> None:
    """Where just two chains meet, make one of them."""
    if net.spots[spot, DEGREE] != 2 or not whole(net, spot):
        return
    first = net.hooks[spot, 0]
    second = net.ends[first, 1]
    one = first // 2
    two = second // 2
    count = net.chains[one, COUNT] + net.chains[two, COUNT] - 1
    if one == two or not fits(net, count):
        return
    a = net.chains[one, 1 - first % 2]
    b = net.chains[two, 1 - second % 2]
    append_cells(net, net.chains[one, START], net.chains[one, COUNT], first % 2 == 0, 0)
    append_cells(net, net.chains[two, START], net.chains[two, COUNT], second % 2 == 1, 1)
    drop_chain(net, one)
    drop_chain(net, two)
    net.spots[spot, DEGREE] = NONE
    add_last(net, a, b, count)


@kernel
def dissolve_all(net: Net, spots: Mask) -> None:
    """Dissolve some spots (S,), in order."""
    for spot in range(spots.size):
        if spots[spot]:
            dissolve(net, spot)


@kernel
def merge(net: Net, number: int, kept: int) -> None:
    """Draw the two ends of a chain together at one of them.

    The other's chains get the way between.
    """
    backwards = net.chains[number, A] != kept
    gone = net.chains[number, A if backwards else B]
    start = net.chains[number, START]
    count = net.chains[number, COUNT]
    if not whole(net, gone):
        return
    drop_chain(net, number)
    while net.hooks[gone, 0] != NONE:
        other = net.hooks[gone, 0] // 2
        a = net.chains[other, A]
        b = net.chains[other, B]
        length = net.chains[other, COUNT]
        total = length + (count - 1) * (np.int64(a == gone) + np.int64(b == gone))
        if not fits(net, total):
            return
        if a == gone:
            append_cells(net, start, count, backwards, 0)
        append_cells(net, net.chains[other, START], length, False, 1 if a == gone else 0)
        if b == gone:
            append_cells(net, start, count, not backwards, 1)
        drop_chain(net, other)
        add_last(net, kept if a == gone else a, kept if b == gone else b, total)
    net.spots[gone, DEGREE] = NONE


@kernel
def draw(net: Net, rows: int, cols: int) -> Mask:
    """The cells of all spots and chains that are left, (rows, cols)."""
    drawing = np.zeros((rows, cols), dtype=np.bool_)
    for spot in range(net.spots.shape[0]):
        if net.spots[spot, DEGREE] != NONE:
            drawing[net.spots[spot, ROW], net.spots[spot, COL]] = True
    for number in range(chain_count(net)):
        if net.chains[number, A] != NONE:
            for k in range(
                net.chains[number, START], net.chains[number, START] + net.chains[number, COUNT]
            ):
                drawing[net.cells[k, 0], net.cells[k, 1]] = True
    return drawing


def web_of_net(net: Net) -> Web:
    """The web that is left."""
    web = Web()
    spots = [
        Spot((row, col), squared) if degree != NONE else None
        for row, col, squared, degree in net.spots.tolist()
    ]
    numbers = [web.add_spot(spot) if spot else NONE for spot in spots]
    for a, b, cells, squared in chains_of(net):
        web.add_chain(Chain(numbers[a], numbers[b], cells, squared))
    return web


def chains_of(net: Net, first: int = 0) -> list[tuple[int, int, Cells, Cells]]:
    """Ends, cells (K, 2), squared clearances (K,) of the chains that are left, from a number on."""
    found = net.chains[first : chain_count(net)]
    parts = [
        (a, b, net.cells[start : start + count])
        for a, b, start, count in found.tolist()
        if a != NONE
    ]
    return [(a, b, part[:, :2].copy(), part[:, 2].copy()) for a, b, part in parts]


def change(web: Web, spots: set[int], act: Callable[[Net, Mask], None]) -> None:
    """Let compiled code change a web round some of its spots.

    It gets a net, and which of its spots (S,) they are.

    As much of the web is put into the net as the code turns out to need. Nothing but that is looked
    at, so the cost does not depend on the size of the web.
    """
    reach = _REACH
    room = 1
    while True:
        numbers, chains, partial = _neighbourhood(web, spots, reach)
        net = _net_in(web, numbers, chains, partial, room)
        chosen = np.array([number in spots for number in numbers], dtype=np.bool_)
        act(net, chosen)
        state = state_of(net)
        if state == DONE:
            return _take_over(web, net, numbers, chains)
        reach, room = (2 * reach, room) if state == SHORT else (reach, 2 * room)


def _neighbourhood(web: Web, spots: set[int], reach: int) -> tuple[list[int], list[int], set[int]]:
    """Numbers of the spots and chains within some chains of those given.

    Also those spots that have others as well.
    """
    known = {spot for spot in spots if spot in web.spots}
    chains: set[int] = set()
    newest = known
    for _ in range(reach):
        found = {number for spot in newest for number in web.chains_at(spot)} - chains
        chains |= found
        newest = {spot for number in found for spot in web.chains[number].ends} - known
        known = known | newest
        if not newest:
            break
    return sorted(known), sorted(chains), newest


def _net_in(web: Web, numbers: list[int], chains: list[int], partial: set[int], room: int) -> Net:
    """The net of some spots and the chains between them."""
    at = {number: k for k, number in enumerate(numbers)}
    nodes = [(*web.spots[number].cell, web.spots[number].squared) for number in numbers]
    ends = [(at[web.chains[number].a], at[web.chains[number].b]) for number in chains]
    starts = np.cumsum([0] + [len(web.chains[number].cells) for number in chains])
    cells = np.empty((starts[-1], 3), dtype=np.int64)
    if chains:
        np.concatenate([web.chains[number].cells for number in chains], out=cells[:, :2])
        np.concatenate([web.chains[number].squared for number in chains], out=cells[:, 2])
    net = net_of(
        np.array(nodes, dtype=np.int64).reshape(-1, 3),
        np.array(ends, dtype=np.int64).reshape(-1, 2),
        starts,
        cells,
        room,
    )
    for number in partial:
        net.partial[at[number]] = True
        net.spots[at[number], DEGREE] = web.degree(number)
    return net


def _take_over(web: Web, net: Net, numbers: list[int], chains: list[int]) -> None:
    """Change a web as the net was that had been made of some of its spots and chains."""
    for k in np.flatnonzero(net.chains[: len(chains), A] == NONE).tolist():
        web.drop_chain(chains[k])
    for number, (row, col, squared, degree) in zip(numbers, net.spots.tolist(), strict=True):
        if degree == NONE:
            web.drop_spot(number)
        elif web.spots[number].cell != (row, col):
            web.move_spot(number, Spot((row, col), squared))
    for a, b, cells, squared in chains_of(net, len(chains)):
        web.add_chain(Chain(numbers[a], numbers[b], cells, squared))
