"""The global web: spots and chains on one unbounded lattice, found by place without looking at all of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.topology.web import Chain, Spot, Web

Cells = NDArray[np.int64]
_BLOCK = 6  # chains are listed by blocks of 2**6 cells
_STRIDE = 16  # of which every so many cells are asked; a search looks as far around


@dataclass
class Cut:
    """How the atlas was cut open.

    anchors: the spot at the first cell within of each chain that goes on outside, by cell; and all spots at which
    chains were cut.
    """

    anchors: dict[tuple[int, int], int]
    touched: set[int]


@dataclass(frozen=True)
class Box:
    """A rectangle of lattice cells: its first row and col, and how many there are."""

    row: int
    col: int
    rows: int
    cols: int

    def holds(self, cells: Cells) -> NDArray[np.bool_]:
        """Which of the cells (..., 2) lie in it."""
        inside: NDArray[np.bool_] = np.all((cells >= (self.row, self.col)) & (cells < self.end), axis=-1)
        return inside

    @property
    def end(self) -> tuple[int, int]:
        """The first row and col after it."""
        return (self.row + self.rows, self.col + self.cols)


class Atlas(Web):
    """A web that knows which chains pass through which block of the lattice, and which spots stand alone."""

    def __init__(self) -> None:
        super().__init__()
        self._blocks: dict[tuple[int, int], set[int]] = {}
        self._blocks_of: dict[int, set[tuple[int, int]]] = {}
        self.lone: set[int] = set()
        self._changed_spots: set[int] = set()
        self._changed_chains: set[int] = set()

    def take_changes(self) -> tuple[set[int], set[int]]:
        """Numbers of the spots and chains that came, went or (spots) got other chains since the last call."""
        changes = self._changed_spots, self._changed_chains
        self._changed_spots, self._changed_chains = set(), set()
        return changes

    def add_spot(self, spot: Spot) -> int:
        """Add a spot; returns its number."""
        number = super().add_spot(spot)
        self._changed_spots.add(number)
        self.lone.add(number)
        return number

    def drop_spot(self, number: int) -> None:
        """Remove a spot at which no chain ends."""
        super().drop_spot(number)
        self._changed_spots.add(number)
        self.lone.discard(number)

    def add_chain(self, chain: Chain) -> int:
        """Add a chain between spots of this web; returns its number."""
        number = super().add_chain(chain)
        self._changed_chains.add(number)
        self._changed_spots |= {chain.a, chain.b}
        self.lone -= {chain.a, chain.b}
        blocks = (chain.cells[::_STRIDE] >> _BLOCK).tolist()
        self._blocks_of[number] = {(row, col) for row, col in blocks}
        for block in self._blocks_of[number]:
            self._blocks.setdefault(block, set()).add(number)
        return number

    def drop_chain(self, number: int) -> None:
        """Remove a chain; its spots stay."""
        chain = self.chains[number]
        super().drop_chain(number)
        self._changed_chains.add(number)
        self._changed_spots |= {chain.a, chain.b}
        self.lone |= {spot for spot in (chain.a, chain.b) if not self.degree(spot)}
        for block in self._blocks_of.pop(number):
            self._blocks[block].discard(number)
            if not self._blocks[block]:
                del self._blocks[block]

    def within(self, box: Box) -> tuple[Cells, Cells]:
        """Cells (N, 2) of the chains and lone spots in a box, and their squared clearances (N,)."""
        near = [self.chains[number] for number in sorted(self._near(box))]
        alone = [self.spots[spot] for spot in sorted(self.lone)]
        cells = [chain.cells for chain in near] + [np.array([spot.cell]) for spot in alone]
        squared = [chain.squared for chain in near] + [np.array([spot.squared]) for spot in alone]
        if not cells:
            return np.empty((0, 2), dtype=np.int64), np.empty(0, dtype=np.int64)
        all_cells, all_squared = np.concatenate(cells), np.concatenate(squared)
        inside = box.holds(all_cells)
        return all_cells[inside], all_squared[inside]

    def cut_out(self, box: Box) -> Cut:
        """Take out all that lies in a box; chains that cross its border end at an anchor just inside."""
        cut = Cut({}, set())
        inner_spots = {spot for spot in self.lone if box.holds(np.array(self.spots[spot].cell))}
        for number in sorted(self._near(box)):
            chain = self.chains[number]
            inside = box.holds(chain.cells)
            if not inside.any():
                continue
            self.drop_chain(number)
            inner_spots |= {spot for spot, held in ((chain.a, inside[0]), (chain.b, inside[-1])) if held}
            self._keep_outside(chain, inside, cut)
        for spot in inner_spots:
            self.drop_spot(spot)
        return cut

    def _near(self, box: Box) -> set[int]:
        found: set[int] = set()
        end_row, end_col = box.end
        for r in range(box.row - _STRIDE >> _BLOCK, (end_row + _STRIDE >> _BLOCK) + 1):
            for c in range(box.col - _STRIDE >> _BLOCK, (end_col + _STRIDE >> _BLOCK) + 1):
                found |= self._blocks.get((r, c), set())
        return found

    def _keep_outside(self, chain: Chain, inside: NDArray[np.bool_], cut: Cut) -> None:
        """Put back the runs of a chain that lie outside, each with the cells inside that it hangs on."""
        changes = np.flatnonzero(np.diff(np.concatenate(([True], inside, [True])).astype(np.int8)))
        for first, end in zip(changes[::2].tolist(), changes[1::2].tolist(), strict=True):
            piece = chain.part(max(first - 1, 0), min(end, len(inside) - 1))
            piece.a = chain.a if first == 0 else self._anchor(piece, 0, cut)
            piece.b = chain.b if end == len(inside) else self._anchor(piece, -1, cut)
            cut.touched |= {piece.a, piece.b}
            self.add_chain(piece)

    def _anchor(self, piece: Chain, end: int, cut: Cut) -> int:
        row, col = piece.cells[end].tolist()
        if (row, col) not in cut.anchors:
            cut.anchors[row, col] = self.add_spot(Spot((row, col), int(piece.squared[end])))
        return cut.anchors[row, col]

    def graft(self, web: Web, box: Box, anchors: dict[tuple[int, int], int]) -> set[int]:
        """Add a web drawn on the cells of a box, its spots at anchors being those; returns its spots."""
        numbers = {}
        for number, spot in web.spots.items():
            cell = (spot.cell[0] + box.row, spot.cell[1] + box.col)
            numbers[number] = anchors[cell] if cell in anchors else self.add_spot(Spot(cell, spot.squared))
        for chain in web.chains.values():
            cells = chain.cells + (box.row, box.col)
            self.add_chain(Chain(numbers[chain.a], numbers[chain.b], cells, chain.squared))
        return set(numbers.values())

    def joined(self, spots: list[int]) -> list[list[int]]:
        """Indices into a list of spots, grouped by which hang together."""
        index_of = {spot: index for index, spot in enumerate(spots)}
        groups = []
        while index_of:
            spot, index = index_of.popitem()
            group, seen, open_spots = [index], {spot}, [spot]
            while open_spots:
                at = open_spots.pop()
                for to in {self.chains[number].other(at) for number in self.chains_at(at)} - seen:
                    seen.add(to)
                    open_spots.append(to)
                    if to in index_of:
                        group.append(index_of.pop(to))
            groups.append(group)
        return groups
