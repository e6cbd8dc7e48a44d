"""The skeleton as a graph: spots joined by chains of cells, and what may be simplified in it."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.jit import kernel
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.config import TopologyConfig

Cells = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(eq=False)
class Chain:
    """A piece of skeleton between the spots a and b.

    cells (K, 2): lattice cells (row, col) from a's to b's, each beside the next; squared (K,): squared clearance in
    cells.
    """

    a: int
    b: int
    cells: Cells
    squared: Cells

    def other(self, spot: int) -> int:
        """The chain's other end (the same for a loop)."""
        return self.b if spot == self.a else self.a

    def reversed(self) -> 'Chain':
        """The same piece from b to a."""
        return Chain(self.b, self.a, self.cells[::-1].copy(), self.squared[::-1].copy())

    def starting_at(self, spot: int) -> 'Chain':
        """The same piece, beginning at one of its ends."""
        return self if spot == self.a else self.reversed()

    def joined(self, following: 'Chain') -> 'Chain':
        """The piece and another one that begins at its last cell."""
        return Chain(
            self.a,
            following.b,
            np.concatenate((self.cells, following.cells[1:])),
            np.concatenate((self.squared, following.squared[1:])),
        )

    def part(self, first: int, last: int) -> 'Chain':
        """The piece from one index to another, inclusive; its ends are named as this chain's."""
        piece = slice(first, last + 1)
        return Chain(self.a, self.b, self.cells[piece], self.squared[piece])

    @cached_property
    def length(self) -> float:
        """Length along the cells, in cells."""
        return path_length(self.cells)


@dataclass(eq=False)
class Spot:
    """A place where chains end or meet: its cell (row, col) and its squared clearance in cells."""

    cell: tuple[int, int]
    squared: int


Promise = Callable[[Spot], bool]


@dataclass(frozen=True)
class Limits:
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


@kernel
def path_length(cells: Cells) -> float:
    """Length along cells (K, 2), each beside the next, in cells."""
    length = 0.0
    for k in range(1, cells.shape[0]):
        length += math.hypot(cells[k, 0] - cells[k - 1, 0], cells[k, 1] - cells[k - 1, 1])
    return length


class Web:
    """Spots and chains by number, and the few changes that keep it connected as the free space is."""

    def __init__(self) -> None:
        self.spots: dict[int, Spot] = {}
        self.chains: dict[int, Chain] = {}
        self._at: dict[int, list[int]] = {}
        self._next = 0

    def add_spot(self, spot: Spot) -> int:
        """Add a spot; returns its number."""
        self._next += 1
        self.spots[self._next] = spot
        self._at[self._next] = []
        return self._next

    def add_chain(self, chain: Chain) -> int:
        """Add a chain between spots of this web; returns its number."""
        self._next += 1
        self.chains[self._next] = chain
        self._at[chain.a].append(self._next)
        self._at[chain.b].append(self._next)
        return self._next

    def drop_chain(self, number: int) -> None:
        """Remove a chain; its spots stay."""
        chain = self.chains.pop(number)
        self._at[chain.a].remove(number)
        self._at[chain.b].remove(number)

    def drop_spot(self, number: int) -> None:
        """Remove a spot at which no chain ends."""
        assert not self._at[number]
        del self.spots[number], self._at[number]

    def degree(self, spot: int) -> int:
        """Chain ends at a spot; a loop counts twice."""
        return len(self._at[spot])

    def chains_at(self, spot: int) -> list[int]:
        """Numbers of the chains that end at a spot; a loop is named twice."""
        return list(self._at[spot])

    def chains_among(self, spots: set[int]) -> list[int]:
        """Numbers of the chains with an end among some spots, each once, in order."""
        return sorted({number for spot in spots if spot in self.spots for number in self._at[spot]})

    def dissolve(self, spot: int) -> None:
        """Where just two chains meet, make one of them."""
        if spot not in self.spots or self.degree(spot) != 2:
            return
        first, second = self._at[spot]
        if first == second:
            return
        one, two = self.chains[first], self.chains[second]
        self.drop_chain(first)
        self.drop_chain(second)
        self.drop_spot(spot)
        self.add_chain((one if one.b == spot else one.reversed()).joined(two.starting_at(spot)))

    def dissolve_all(self, spots: set[int]) -> None:
        """Dissolve some spots, in order."""
        for spot in sorted(spot for spot in spots if len(self._at.get(spot, ())) == 2):
            self.dissolve(spot)

    def merge(self, number: int, kept: int) -> None:
        """Draw the two ends of a chain together at one of them; the other's chains get the way between."""
        chain = self.chains[number].starting_at(kept)
        gone = chain.b
        self.drop_chain(number)
        for other in dict.fromkeys(self.chains_at(gone)):
            moved = self.chains[other]
            self.drop_chain(other)
            if moved.a == gone:
                moved = chain.joined(moved)
            if moved.b == gone:
                moved = moved.joined(chain.reversed())
            self.add_chain(moved)
        self.drop_spot(gone)


def simplify(
    web: Web,
    spots: set[int],
    promising: Promise,
    limits: Limits,
) -> None:
    """Round some spots: draw close branches together, drop the branches of noise, join what then needs no node.

    promising: whether the tip of a branch looks into the unknown.
    """
    web.dissolve_all(spots)
    while _drop_spurs(web, spots, promising, limits):
        pass
    _merge_close(web, spots, limits.join)
    _drop_hollow(web, spots, limits.radius)
    web.dissolve_all(spots)
    _move_rings(web, spots)


def _merge_close(web: Web, spots: set[int], limit: float) -> None:
    """Make one branch of two that are joined by a short chain, shortest first; the roomier place stays."""
    candidates = [n for n in web.chains_among(spots) if len(web.chains[n].cells) <= limit + 1.0]
    open_numbers = sorted((web.chains[n].length, n) for n in candidates)
    for length, number in open_numbers:
        chain = web.chains.get(number)
        if chain is None or length > limit or chain.a == chain.b:
            continue
        if web.degree(chain.a) < 3 or web.degree(chain.b) < 3:
            continue
        web.merge(number, chain.a if web.spots[chain.a].squared >= web.spots[chain.b].squared else chain.b)


def _drop_hollow(web: Web, spots: set[int], radius: float) -> None:
    """Drop what closes a ring round nothing; of chains side by side the shortest stays.

    A ring keeps the robot's radius from what it goes round, so it encloses a disc of that radius at least. What
    encloses less is left over from sewing and from drawing branches together: a way there and back, or one way twice.
    """
    # Cells lie up to half a cell beside the true ring; round a single cell goes a ring of area 2.
    least = max(math.pi * (radius - 0.5) ** 2, 1.0)
    side_by_side: dict[tuple[int, int], list[int]] = {}
    for number in web.chains_among(spots):
        chain = web.chains[number]
        side_by_side.setdefault((min(chain.a, chain.b), max(chain.a, chain.b)), []).append(number)
    for (a, b), numbers in side_by_side.items():
        kept: list[Chain] = []
        # Most chains are alone, and need no length.
        ordered = sorted(numbers, key=lambda n: (web.chains[n].length, n)) if len(numbers) > 1 else numbers
        for number in ordered:
            chain = web.chains[number]
            back = [other.starting_at(chain.b).cells[1:] for other in kept] if a != b else [chain.cells[:0]]
            if any(_area(np.concatenate((chain.cells, way))) < least for way in back):
                web.drop_chain(number)
            else:
                kept.append(chain)


def _area(ring: Cells) -> float:
    """Area, in cells, inside a closed way along cells (K, 2): Gauss's shoelace formula."""
    rows, cols = ring.T
    return abs(float(rows @ np.roll(cols, -1) - cols @ np.roll(rows, -1))) / 2.0


def _drop_spurs(
    web: Web,
    spots: set[int],
    promising: Promise,
    limits: Limits,
) -> bool:
    """One round of pruning; whether anything was dropped.

    A spur is a chain with one free end. What it adds to the place where it begins is the length by which the space
    round its tip reaches beyond the space round its base: length + room(tip) - room(base), room being clearance less
    robot radius. Up to spur_m that is noise; and where the tip looks at known walls only, up to spur_ratio of the
    base's room too (a right-angled corner of a room adds 0.41 of it). So is one that lies in the room round other
    chains from its base altogether: what is left where an old piece of skeleton runs beside a new one. All spurs of a
    round go together, so that the two corners at the end of a corridor leave its middle as the end.
    """
    radius = limits.radius
    gone = []
    for number in web.chains_among(spots):
        chain = web.chains[number]
        spur = _as_spur(web, chain)
        if spur is None:
            continue
        tip, base = spur
        tip_room, base_room = (math.sqrt(web.spots[spot].squared) - radius for spot in (tip, base))
        adds = chain.length + tip_room - base_room
        seen = adds <= limits.spur_ratio * base_room and not promising(web.spots[tip])
        if adds <= limits.spur or seen:
            gone.append((number, tip, base))
        elif not gone and _adds_nothing(web, number, base, radius):
            gone.append((number, tip, base))
            break
    for number, tip, _ in gone:
        web.drop_chain(number)
        web.drop_spot(tip)
    web.dissolve_all({base for _, _, base in gone})
    return bool(gone)


def _adds_nothing(web: Web, number: int, base: int, radius: float) -> bool:
    """Whether a spur lies in the room round other chains, those at its base and at the next spots, altogether."""
    near = {spot for other in web.chains_at(base) for spot in (web.chains[other].a, web.chains[other].b)}
    others = [web.chains[other] for other in web.chains_among(near) if other != number]
    if not others:
        return False
    # From the tip on: that is where most spurs stand out.
    spur = web.chains[number].starting_at(base).cells[::-1]
    cells = np.concatenate([chain.cells for chain in others])
    squared = np.concatenate([chain.squared for chain in others])
    return bool(_is_covered(np.ascontiguousarray(spur), cells, squared, radius))


def _as_spur(web: Web, chain: Chain) -> tuple[int, int] | None:
    """The free end of a chain and its other end; of two free ends the one with less room; None without any."""
    a, b = chain.a, chain.b
    if a == b or (web.degree(a) != 1 and web.degree(b) != 1):
        return None
    if web.degree(a) == 1 and web.degree(b) == 1:
        return (a, b) if web.spots[a].squared <= web.spots[b].squared else (b, a)
    return (a, b) if web.degree(a) == 1 else (b, a)


def _move_rings(web: Web, spots: set[int]) -> None:
    """Put the one node of each ring at the ring's cell that is farthest from its middle, wherever tracing began."""
    for number in web.chains_among(spots):
        chain = web.chains[number]
        if chain.a != chain.b or web.degree(chain.a) != 2:
            continue
        middle = (chain.cells.min(axis=0) + chain.cells.max(axis=0)) / 2.0
        distance = np.hypot(*(chain.cells[:-1] - middle).T)
        near_best = np.flatnonzero(distance >= distance.max() - 2.0)
        start = int(near_best[np.lexsort((chain.cells[near_best, 1], chain.cells[near_best, 0]))[0]])
        turned = chain.part(start, len(chain.cells) - 1).joined(chain.part(0, start))
        row, col = turned.cells[0].tolist()
        web.drop_chain(number)
        web.spots[chain.a] = Spot((row, col), int(turned.squared[0]))
        web.add_chain(turned)


def room_along(chain: Chain, radius_cells: float) -> Array:
    """How far, in cells, the robot's centre may leave each cell of a chain, (K,)."""
    room: Array = np.sqrt(chain.squared) - radius_cells
    return room


@kernel
def _is_covered(cells: Cells, others: Cells, squared: Cells, radius: float) -> bool:
    """Whether all cells (N, 2) lie in the room round the others (M, 2), whose squared clearances are given, (M,)."""
    room = np.sqrt(squared) - radius
    for i in range(cells.shape[0]):
        covered = False
        for j in range(others.shape[0]):
            row, col = cells[i, 0] - others[j, 0], cells[i, 1] - others[j, 1]
            if room[j] >= 0.0 and row * row + col * col <= room[j] * room[j]:
                covered = True
                break
        if not covered:
            return False
    return True
