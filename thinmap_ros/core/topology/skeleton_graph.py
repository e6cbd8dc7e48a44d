"""The skeleton as a graph: spots joined by chains of cells."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.jit import kernel
from thinmap_ros.core.se2 import Array

Cells = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(eq=False)
class Chain:
    """A piece of skeleton between the spots a and b.

    cells (K, 2): lattice cells (row, col) from a's to b's, each beside the next; squared (K,):
    squared clearance in cells.
    """

    a: int
    b: int
    cells: Cells
    squared: Cells

    @property
    def ends(self) -> tuple[int, int]:
        """The spots at its ends."""
        return self.a, self.b

    def other(self, spot: int) -> int:
        """The chain's other end (the same for a loop)."""
        return self.b if spot == self.a else self.a

    def part(self, first: int, last: int) -> 'Chain':
        """The piece from one index to another, inclusive; its ends are named as this chain's."""
        piece = slice(first, last + 1)
        return Chain(self.a, self.b, self.cells[piece], self.squared[piece])

    @cached_property
    def extent(self) -> tuple[int, int, int, int]:
        """The first row and col of its cells, and the last ones."""
        return extent(self.cells)

    @cached_property
    def length(self) -> float:
        """Length along the cells, in cells."""
        return path_length(self.cells)


@dataclass(eq=False)
class Spot:
    """A place where chains end or meet: its cell (row, col) and its squared clearance in cells."""

    cell: tuple[int, int]
    squared: int


@kernel
def extent(cells: Cells) -> tuple[int, int, int, int]:
    """Smallest row and col of cells (K, 2), and the largest ones."""
    low_row = high_row = cells[0, 0]
    low_col = high_col = cells[0, 1]
    for k in range(1, cells.shape[0]):
        low_row = min(low_row, cells[k, 0])
        high_row = max(high_row, cells[k, 0])
        low_col = min(low_col, cells[k, 1])
        high_col = max(high_col, cells[k, 1])
    return low_row, low_col, high_row, high_col


@kernel
def path_length(cells: Cells) -> float:
    """Length along cells (K, 2), each beside the next, in cells."""
    length = 0.0
    for k in range(1, cells.shape[0]):
        length += math.hypot(cells[k, 0] - cells[k - 1, 0], cells[k, 1] - cells[k - 1, 1])
    return length


class Web:
    """Spots and chains by number."""

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

    def move_spot(self, number: int, spot: Spot) -> None:
        """Put a spot elsewhere; its chains are to follow."""
        self.spots[number] = spot

    def degree(self, spot: int) -> int:
        """Chain ends at a spot; a loop counts twice."""
        return len(self._at[spot])

    def chains_at(self, spot: int) -> list[int]:
        """Numbers of the chains that end at a spot; a loop is named twice."""
        return list(self._at[spot])


def room_along(chain: Chain, radius_cells: float) -> Array:
    """How far, in cells, the robot's centre may leave each cell of a chain, (K,)."""
    room: Array = np.sqrt(chain.squared) - radius_cells
    return room
