"""The global web: spots and chains on one unbounded lattice, found by place, not by a search."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.snapshot import MAX_CELL_INDEX, MAX_COUNT, Field
from thinmap_ros.core.topology.net import Net, chains_of
from thinmap_ros.core.topology.skeleton_graph import Chain, Spot, Web

Cells = NDArray[np.int64]
_BLOCK = 6  # chains are listed by blocks of 2**6 cells
_STRIDE = 16  # of which every so many cells are asked; a search looks as far around
_RIM = 4  # cells at the border of a cut in which no spot may lie
_LARGEST_SQUARED = 2**32  # of a clearance, in cells
FIELDS = {
    # number, row, col, squared clearance
    'spots': Field(
        np.int64,
        ('n', 4),
        (1, -MAX_CELL_INDEX, -MAX_CELL_INDEX, 0),
        (MAX_COUNT, MAX_CELL_INDEX, MAX_CELL_INDEX, _LARGEST_SQUARED),
    ),
    # number, spot a, spot b, how many cells
    'chains': Field(np.int64, ('m', 4), 1, MAX_COUNT),
    # row, col, squared clearance, chain after chain
    'cells': Field(
        np.int64,
        ('k', 3),
        (-MAX_CELL_INDEX, -MAX_CELL_INDEX, 0),
        (MAX_CELL_INDEX, MAX_CELL_INDEX, _LARGEST_SQUARED),
    ),
    'next': Field(np.int64, (1,), 0, MAX_COUNT),
}


@dataclass
class Cut:
    """How the atlas was cut open.

    anchors: the spot at the first cell within of each chain that goes on outside, by cell; and all
    spots at which chains were cut.
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
        inside: NDArray[np.bool_] = np.all(
            (cells >= (self.row, self.col)) & (cells < self.end), axis=-1
        )
        return inside

    def has(self, cell: tuple[int, int]) -> bool:
        """Whether a cell lies in it."""
        return 0 <= cell[0] - self.row < self.rows and 0 <= cell[1] - self.col < self.cols

    @property
    def end(self) -> tuple[int, int]:
        """The first row and col after it."""
        return (self.row + self.rows, self.col + self.cols)

    def grown(self, rim: int) -> 'Box':
        """The same with a rim round it, or less a rim where it is negative."""
        return Box(self.row - rim, self.col - rim, self.rows + 2 * rim, self.cols + 2 * rim)

    def middle(self, size: int) -> 'Box':
        """The square of at most so many rows and columns in its middle."""
        rows = max(self.rows - size, 0) // 2
        cols = max(self.cols - size, 0) // 2
        return Box(self.row + rows, self.col + cols, min(self.rows, size), min(self.cols, size))

    def within(self, outer: 'Box') -> tuple[slice, slice]:
        """Where it lies in an array of the outer one's cells."""
        row = self.row - outer.row
        col = self.col - outer.col
        return slice(row, row + self.rows), slice(col, col + self.cols)

    def meets(self, other: 'Box') -> bool:
        """Whether the two share a cell or touch."""
        rows = self.row <= other.end[0] and other.row <= self.end[0]
        return rows and self.col <= other.end[1] and other.col <= self.end[1]

    def around(self, cells: Cells, rim: int, limit: 'Box') -> 'Box':
        """The smallest box round this one and cells (N, 2) with their rim; ends at the limit."""
        low = np.maximum(
            np.minimum((self.row, self.col), cells.min(axis=0) - rim), (limit.row, limit.col)
        )
        high = np.minimum(np.maximum(self.end, cells.max(axis=0) + rim + 1), limit.end)
        return Box(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))


class Atlas(Web):
    """A web that knows which chains pass through which block, and which spots stand alone."""

    def __init__(self) -> None:
        super().__init__()
        self._blocks: dict[tuple[int, int], set[int]] = {}
        self._blocks_of: dict[int, set[tuple[int, int]]] = {}
        self.lone: set[int] = set()
        self._changed_spots: set[int] = set()
        self._changed_chains: set[int] = set()

    def state(self) -> dict[str, Cells]:
        """The web as arrays.

        Spots (number, row, col, squared clearance), chains (number, a, b, cells) and their cells.
        """
        spots = [(number, *spot.cell, spot.squared) for number, spot in self.spots.items()]
        chains = [
            (number, chain.a, chain.b, len(chain.cells)) for number, chain in self.chains.items()
        ]
        cells = [np.column_stack([chain.cells, chain.squared]) for chain in self.chains.values()]
        return {
            'spots': np.array(spots, dtype=np.int64).reshape(-1, 4),
            'chains': np.array(chains, dtype=np.int64).reshape(-1, 4),
            'cells': np.concatenate([np.empty((0, 3), dtype=np.int64), *cells]),
            'next': np.array([self._next]),
        }

    @staticmethod
    def from_state(state: Mapping[str, Cells]) -> 'Atlas':
        """The web that another one's `state` describes, with the same numbers.

        state: checked by FIELDS. Raises InputError where its arrays contradict each other.
        """
        _check_references(state)
        atlas = Atlas()
        for number, row, col, squared in state['spots'].tolist():
            atlas._next = number - 1
            atlas.add_spot(Spot((row, col), squared))
        start = 0
        for number, a, b, count in state['chains'].tolist():
            part = state['cells'][start : start + count]
            atlas._next = number - 1
            start = start + count
            atlas.add_chain(
                Chain(a, b, np.ascontiguousarray(part[:, :2]), np.ascontiguousarray(part[:, 2]))
            )
        atlas._next = int(state['next'][0])
        atlas.take_changes()
        return atlas

    def take_changes(self) -> tuple[set[int], set[int]]:
        """Numbers of the spots and chains that came or went since the last call.

        Also of the spots that got other chains.
        """
        changes = self._changed_spots, self._changed_chains
        self._changed_spots = set()
        self._changed_chains = set()
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
        all_cells = np.concatenate(cells)
        all_squared = np.concatenate(squared)
        inside = box.holds(all_cells)
        return all_cells[inside], all_squared[inside]

    def cut_out(self, box: Box) -> Cut:
        """Take out all that lies in a box.

        Chains that cross its border end at an anchor just inside.
        """
        cut = Cut({}, set())
        inner_spots = {spot for spot in self.lone if box.has(self.spots[spot].cell)}
        for number in sorted(self._near(box)):
            chain = self.chains[number]
            outside = _runs_outside(chain, box)
            if outside == [(0, len(chain.cells))]:
                continue
            self.drop_chain(number)
            inner_spots |= {spot for spot in (chain.a, chain.b) if box.has(self.spots[spot].cell)}
            self._keep(chain, outside, cut)
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

    def _keep(self, chain: Chain, outside: list[tuple[int, int]], cut: Cut) -> None:
        """Put back the runs of a chain outside, each with the cells inside that it hangs on."""
        count = len(chain.cells)
        for first, end in outside:
            piece = chain.part(max(first - 1, 0), min(end, count - 1))
            piece.a = chain.a if first == 0 else self._anchor(piece, 0, cut)
            piece.b = chain.b if end == count else self._anchor(piece, -1, cut)
            cut.touched |= {piece.a, piece.b}
            self.add_chain(piece)

    def _anchor(self, piece: Chain, end: int, cut: Cut) -> int:
        row, col = piece.cells[end].tolist()
        if (row, col) not in cut.anchors:
            cut.anchors[row, col] = self.add_spot(Spot((row, col), int(piece.squared[end])))
        return cut.anchors[row, col]

    def graft(self, net: Net, box: Box, anchors: dict[tuple[int, int], int]) -> set[int]:
        """Add a whole net drawn on the cells of a box, its spots at anchors being those.

        Returns its spots.
        """
        numbers = []
        for row, col, squared, _ in net.spots.tolist():
            cell = (row + box.row, col + box.col)
            numbers.append(anchors[cell] if cell in anchors else self.add_spot(Spot(cell, squared)))
        for a, b, cells, squared in chains_of(net):
            self.add_chain(Chain(numbers[a], numbers[b], cells + (box.row, box.col), squared))
        return set(numbers)

    def calm(self, box: Box, limit: Box) -> Box:
        """A box, made larger until no spot lies at its border.

        There, chains that are cut would touch each other.
        """
        while True:
            reach = box.grown(_RIM)
            inner = box.grown(-_RIM)
            ends = {
                spot
                for number in self._near(reach)
                for spot in (self.chains[number].a, self.chains[number].b)
            }
            cells = [self.spots[spot].cell for spot in ends]
            cells = [cell for cell in cells if reach.has(cell) and not inner.has(cell)]
            wider = box.around(np.array(cells), _RIM + 1, limit) if cells else box
            if wider == box:
                return box
            box = wider

    def joined_outside(self, box: Box, parts: NDArray[np.int32]) -> list[set[int]]:
        """Numbers in `parts` (H, W), drawn on the cells of a box, that chains outside the box join.

        Looks no farther from the box than it takes to find all parts that go on outside, wherever
        that is possible.
        """
        near = self._near(box)
        links = self._links(near, box, parts)
        left = {at for at in links if at > 0}
        groups = []
        while left:
            group = {left.pop()}
            open_ends = deque[int]()
            open_ends.extend(group)
            seen = {0, *group}
            while open_ends and left:
                at = open_ends.popleft()
                found = links.get(at, set()) - seen
                if at < 0:
                    others = {-self.chains[n].other(-at) for n in self._at[-at] if n not in near}
                    found |= others - seen
                seen |= found
                open_ends.extend(found)
                group |= found & left
                left -= found
            groups.append(group)
        return groups

    def _links(self, near: set[int], box: Box, parts: NDArray[np.int32]) -> dict[int, set[int]]:
        """What the runs of some chains outside a box join.

        Parts (positive numbers, 0: none) and spots (negative).
        """
        links: dict[int, set[int]] = {}
        for number in near:
            chain = self.chains[number]
            for first, end in _runs_outside(chain, box):
                a = (
                    -chain.a
                    if first == 0
                    else int(parts[tuple(chain.cells[first - 1] - (box.row, box.col))])
                )
                b = (
                    -chain.b
                    if end == len(chain.cells)
                    else int(parts[tuple(chain.cells[end] - (box.row, box.col))])
                )
                links.setdefault(a, set()).add(b)
                links.setdefault(b, set()).add(a)
        return links


def _check_references(state: Mapping[str, Cells]) -> None:
    """Raise InputError unless each chain runs, cell by cell, from one of the spots to another."""
    spots = state['spots']
    chains = state['chains']
    cells = state['cells']
    numbers = np.concatenate([spots[:, 0], chains[:, 0]])
    snapshot.require_unique(numbers, 'topology: number of a spot or chain')
    last = int(numbers.max(initial=0))
    newest = int(state['next'][0])
    snapshot.require(last <= newest, f'topology: next {newest}', f'at least {last}')
    snapshot.require_known(chains[:, 1:3].ravel(), spots[:, 0], 'topology: spot of a chain')
    counts = chains[:, 3]
    fits = bool((counts <= len(cells)).all()) and int(counts.sum()) == len(cells)
    snapshot.require(fits, f'topology: {len(cells)} cells', 'as many as the chains have')
    if not len(chains):
        return
    ends = np.cumsum(counts)
    starts = ends - counts
    steps = np.abs(np.diff(cells[:, :2], axis=0)).max(axis=1, initial=0)
    steps[ends[:-1] - 1] = 0  # from one chain to the next
    beside = bool((steps <= 1).all())
    snapshot.require(beside, 'topology: cells', 'each beside the next of its chain')
    order = np.argsort(spots[:, 0])
    for column, at in ((1, starts), (2, ends - 1)):
        row = order[np.searchsorted(spots[:, 0], chains[:, column], sorter=order)]
        together = np.array_equal(spots[row, 1:3], cells[at, :2])
        snapshot.require(together, 'topology: ends of chains', 'the cells of their spots')


def _runs_outside(chain: Chain, box: Box) -> list[tuple[int, int]]:
    """First index and end of each run of a chain's cells that lie outside a box."""
    low_row, low_col, high_row, high_col = chain.extent
    end_row, end_col = box.end
    if high_row < box.row or high_col < box.col or low_row >= end_row or low_col >= end_col:
        return [(0, len(chain.cells))]
    if low_row >= box.row and low_col >= box.col and high_row < end_row and high_col < end_col:
        return []
    return [
        (first, end)
        for first, end in _runs(chain.cells, box.row, box.col, end_row, end_col).tolist()
    ]


@kernel
def _runs(cells: Cells, row: int, col: int, end_row: int, end_col: int) -> Cells:
    runs = np.empty((cells.shape[0] // 2 + 1, 2), dtype=np.int64)
    count = 0
    was_outside = False
    for k in range(cells.shape[0]):
        outside = not (row <= cells[k, 0] < end_row and col <= cells[k, 1] < end_col)
        if outside and not was_outside:
            runs[count, 0] = k
            count += 1
        if outside:
            runs[count - 1, 1] = k + 1
        was_outside = outside
    return runs[:count]
