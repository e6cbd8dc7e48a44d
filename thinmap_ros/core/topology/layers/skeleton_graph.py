"""The skeleton as a graph: vertices where it ends or branches, chains of cells between them.

Skeleton cells are joined over edges, and over corners only where no path over edges leads around
(mixed adjacency). So a junction is one cell, a staircase is a passage, and whether a cell is a
vertex follows from its eight neighbours. When cells of the skeleton change, only the chains and
vertices that hold these cells, or one beside them, are removed and traced again.
Source: exploration paper section 2.2, Fig. 3 (a) and (b).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array, Cells
from thinmap_ros.core.topology.layers.lattice import (
    Lattice,
    col_of,
    hash_of,
    key_of,
    neighbour,
    row_of,
    sorted_unique,
)
from thinmap_ros.jit import inlined, kernel

NONE = -1
# Columns of `vertices`: its cell (NONE: unused), then the chains at it.
CELL = 0
SLOT = 1
MAX_DEGREE = 4
# Columns of `chains`: vertices at its ends (NONE: unused), the passage cells next to them, the
# number of passage cells, and a hash of all its cells, by which two chains are compared.
A = 0
B = 1
FIRST = 2
LAST = 3
COUNT = 4
HASH = 5
_SHORTEST_RING = 4  # cells, joined over corners around a hole of one cell
_SPARE_ROWS = 16


def _joined() -> NDArray[np.int64]:
    """[neighbours as bits] -> those that are joined to the cell, as bits."""
    table = np.zeros(256, dtype=np.int64)
    for code in range(256):
        for k in range(8):
            over_edge = k % 2 and (code >> (k - 1) & 1 or code >> ((k + 1) % 8) & 1)
            if code >> k & 1 and not over_edge:
                table[code] |= 1 << k
    return table


_JOINED = _joined()
_DEGREE = np.array([int(bits).bit_count() for bits in _JOINED])


class Arrays(NamedTuple):
    """Vertices and chains of a skeleton, for kernels.

    vertices (V, 5), chains (C, 6): see the columns; lengths (C,): of the chains, in cells; spare:
    the unused rows of vertices and of chains, the first number is how many.
    """

    lattice: Lattice
    vertices: Cells
    chains: Cells
    lengths: Array
    spare: tuple[Cells, Cells]


class SkeletonGraph:
    """Vertices and chains of the skeleton cells of a lattice."""

    def __init__(self, lattice: Lattice) -> None:
        self.arrays = Arrays(
            lattice,
            np.full((0, 1 + MAX_DEGREE), NONE, dtype=np.int64),
            np.full((0, HASH + 1), NONE, dtype=np.int64),
            np.zeros(0),
            (np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64)),
        )

    def update(self, lattice: Lattice, changed: Cells) -> None:
        """Flip cells (N,) of the skeleton, and trace again what they touch."""
        self.arrays = self.arrays._replace(lattice=lattice)
        loose = changed
        open_vertices = changed[:0]
        if len(self.arrays.vertices):
            loose, open_vertices = _remove(self.arrays, changed)
        lattice.cells['kept'][changed] ^= 1
        loose = sorted_unique(loose)
        self._reserve(_most_vertices(self.arrays, loose))
        _trace(self.arrays, loose, open_vertices)

    def _reserve(self, count: int) -> None:
        """Make room for so many vertices, and for the chains that each can have."""
        arrays = self.arrays
        vertices, spare_vertices = _with_rows(arrays.vertices, arrays.spare[0], count + _SPARE_ROWS)
        chains, spare_chains = _with_rows(
            arrays.chains, arrays.spare[1], MAX_DEGREE * (count + _SPARE_ROWS)
        )
        lengths = np.zeros(len(chains))
        lengths[: arrays.lengths.size] = arrays.lengths
        spare = (spare_vertices, spare_chains)
        self.arrays = Arrays(arrays.lattice, vertices, chains, lengths, spare)


def _with_rows(table: Cells, spare: Cells, needed: int) -> tuple[Cells, Cells]:
    """A table with so many unused rows, and these."""
    if spare[0] >= needed:
        return table, spare
    more = max(needed, len(table) // 4)
    rows = np.concatenate((spare[1 : spare[0] + 1], np.arange(more) + len(table)))
    unused = np.zeros(len(table) + more + 1, dtype=np.int64)
    unused[0] = rows.size
    unused[1 : rows.size + 1] = rows
    blank = np.full((more, table.shape[1]), NONE, dtype=np.int64)
    return np.concatenate((table, blank)), unused


@inlined
def _neighbour_bits(lattice: Lattice, at: int) -> int:
    """The skeleton cells around a cell, as bits."""
    code = 0
    for k in range(8):
        code |= int(lattice.cells[neighbour(lattice, at, k)]['kept']) << k
    return code


@inlined
def _is_passage(lattice: Lattice, at: int) -> bool:
    return bool(_DEGREE[_neighbour_bits(lattice, at)] == 2)


@inlined
def _next(lattice: Lattice, before: int, at: int) -> int:
    """The cell that follows on a passage after `before`, `at`."""
    bits = _JOINED[_neighbour_bits(lattice, at)]
    for k in range(8):
        to = neighbour(lattice, at, k)
        if bits >> k & 1 and to != before:
            return to
    return before


@kernel
def _remove_chain(arrays: Arrays, number: int, loose: Cells, count: int) -> int:
    """Remove a chain; its passage cells are appended to `loose`, whose length is returned."""
    chain = arrays.chains[number]
    before = arrays.vertices[chain[A], CELL]
    at = chain[FIRST]
    for _ in range(chain[COUNT]):
        arrays.lattice.cells[at]['owner'] = 0
        loose[count] = at
        count += 1
        following = _next(arrays.lattice, before, at)
        before = at
        at = following
    for end in (chain[A], chain[B]):
        for slot in range(SLOT, SLOT + MAX_DEGREE):
            if arrays.vertices[end, slot] == number:
                arrays.vertices[end, slot] = NONE
    chain[A] = NONE
    unused = arrays.spare[1]
    unused[0] += 1
    unused[unused[0]] = number
    return count


@kernel
def _remove(arrays: Arrays, changed: Cells) -> tuple[Cells, Cells]:
    """Remove vertices and chains with changed cells, or with cells beside them.

    Returns the cells that may belong to something new, and the vertices that lost a chain.
    """
    lattice = arrays.lattice
    loose = np.empty(9 * changed.size + 64, dtype=np.int64)
    ends = np.empty(18 * changed.size + 64, dtype=np.int64)
    count = 0
    lost = 0
    numbers = np.empty(MAX_DEGREE, dtype=np.int64)
    for centre in changed:
        for k in range(9):
            at = neighbour(lattice, centre, k) if k < 8 else centre
            owner = lattice.cells[at]['owner']
            numbers[:] = NONE
            if owner > 0:
                numbers[0] = owner - 1
            elif owner < 0:
                numbers[:] = arrays.vertices[-owner - 1, SLOT:]
            for number in numbers:
                if number == NONE or arrays.chains[number, A] == NONE:
                    continue
                while loose.size - count < arrays.chains[number, COUNT] + 16:
                    loose = np.concatenate((loose, np.empty_like(loose)))
                if ends.size - lost < 4:
                    ends = np.concatenate((ends, np.empty_like(ends)))
                ends[lost] = arrays.chains[number, A]
                ends[lost + 1] = arrays.chains[number, B]
                lost += 2
                count = _remove_chain(arrays, int(number), loose, count)
            if loose.size - count < 16:
                loose = np.concatenate((loose, np.empty_like(loose)))
            if owner < 0:
                count = _remove_vertex(arrays, -owner - 1, loose, count)
            loose[count] = at
            count += 1
    for vertex in ends[:lost]:
        # The vertex of a ring is a passage cell: without its chain it is no vertex.
        cell = arrays.vertices[vertex, CELL]
        if cell != NONE and _is_passage(lattice, cell):
            if loose.size - count < 16:
                loose = np.concatenate((loose, np.empty_like(loose)))
            count = _remove_vertex(arrays, vertex, loose, count)
    return loose[:count].copy(), ends[:lost].copy()


@kernel
def _remove_vertex(arrays: Arrays, vertex: int, loose: Cells, count: int) -> int:
    """Remove a vertex; its cell is appended to `loose`, whose length is returned."""
    cell = arrays.vertices[vertex, CELL]
    arrays.lattice.cells[cell]['owner'] = 0
    arrays.vertices[vertex, CELL] = NONE
    unused = arrays.spare[0]
    unused[0] += 1
    unused[unused[0]] = vertex
    loose[count] = cell
    return count + 1


@inlined
def _add_vertex(arrays: Arrays, cell: int) -> int:
    unused = arrays.spare[0]
    vertex = int(unused[unused[0]])
    unused[0] -= 1
    arrays.vertices[vertex, CELL] = cell
    arrays.vertices[vertex, SLOT:] = NONE
    arrays.lattice.cells[cell]['owner'] = -(vertex + 1)
    return vertex


@kernel
def _most_vertices(arrays: Arrays, loose: Cells) -> int:
    """Number of vertices that tracing can add at most."""
    lattice = arrays.lattice
    count = 1
    passages = 0
    for at in loose:
        if lattice.cells[at]['kept'] and lattice.cells[at]['owner'] == 0:
            is_passage = _is_passage(lattice, at)
            count += not is_passage
            passages += is_passage
    return count + passages // _SHORTEST_RING


@kernel
def _trace(arrays: Arrays, loose: Cells, open_vertices: Cells) -> None:
    """Make vertices and chains of the skeleton cells that belong to none."""
    lattice = arrays.lattice
    cells = lattice.cells
    starts = np.empty(loose.size + open_vertices.size, dtype=np.int64)
    count = 0
    for vertex in open_vertices:
        if arrays.vertices[vertex, CELL] != NONE:
            starts[count] = vertex
            count += 1
    for at in loose:
        if cells[at]['kept'] and cells[at]['owner'] == 0 and not _is_passage(lattice, at):
            starts[count] = _add_vertex(arrays, at)
            count += 1
    for vertex in starts[:count]:
        _trace_from(arrays, vertex)
    for at in loose:
        if cells[at]['kept'] and cells[at]['owner'] == 0:
            _trace_from(arrays, _add_vertex(arrays, _first_of_ring(lattice, at)))


@kernel
def _first_of_ring(lattice: Lattice, start: int) -> int:
    """First cell of a ring by its key, from whichever cell it was found."""
    least = start
    before = start
    cell = _next(lattice, start, start)
    while cell != start:
        if key_of(lattice, cell) < key_of(lattice, least):
            least = cell
        following = _next(lattice, before, cell)
        before = cell
        cell = following
    return least


@kernel
def _trace_from(arrays: Arrays, vertex: int) -> None:
    """Trace the chains that begin at a vertex and are not known."""
    lattice = arrays.lattice
    cell = arrays.vertices[vertex, CELL]
    bits = _JOINED[_neighbour_bits(lattice, cell)]
    for k in range(8):
        first = neighbour(lattice, cell, k)
        owner = lattice.cells[first]['owner']
        if not bits >> k & 1 or owner > 0:
            continue
        if owner < 0 and _is_linked(arrays, vertex, -owner - 1):
            continue
        unused = arrays.spare[1]
        number = unused[unused[0]]
        unused[0] -= 1
        _follow(arrays, vertex, first, number)
        arrays.lengths[number] = path_length(lattice, chain_cells(arrays, number))


@kernel
def _follow(arrays: Arrays, vertex: int, first: int, number: int) -> None:
    """Make the chain of a number: from a vertex over the cell `first` to the next vertex."""
    lattice = arrays.lattice
    cell = arrays.vertices[vertex, CELL]
    before = cell
    at = first
    passed = 0
    total = hash_of(lattice, cell)
    while lattice.cells[at]['owner'] >= 0:
        lattice.cells[at]['owner'] = number + 1
        total += hash_of(lattice, at)
        passed += 1
        following = _next(lattice, before, at)
        before = at
        at = following
    other = -lattice.cells[at]['owner'] - 1
    chain = arrays.chains[number]
    chain[A] = vertex
    chain[B] = other
    chain[FIRST] = first
    chain[LAST] = before
    chain[COUNT] = passed
    chain[HASH] = total + hash_of(lattice, at)
    # From the same end, whichever was found first, so that its length is the same.
    is_ring = at == cell
    if key_of(lattice, at) < key_of(lattice, cell) or (
        is_ring and key_of(lattice, before) < key_of(lattice, first)
    ):
        chain[A] = other
        chain[B] = vertex
        chain[FIRST] = before if passed else cell
        chain[LAST] = first
    for end in (vertex, other):
        for slot in range(SLOT, SLOT + MAX_DEGREE):
            if arrays.vertices[end, slot] == NONE:
                arrays.vertices[end, slot] = number
                break


@inlined
def _is_linked(arrays: Arrays, vertex: int, other: int) -> bool:
    """Whether two adjacent vertices are joined already."""
    for number in arrays.vertices[vertex, SLOT:]:
        if number == NONE or arrays.chains[number, COUNT] > 0:
            continue
        if other in (arrays.chains[number, A], arrays.chains[number, B]):
            return True
    return False


@kernel
def chain_cells(arrays: Arrays, number: int) -> Cells:
    """Cells of a chain from vertex to vertex, without the corners of staircases."""
    chain = arrays.chains[number]
    cells = np.empty(chain[COUNT] + 2, dtype=np.int64)
    cells[0] = arrays.vertices[chain[A], CELL]
    at = chain[FIRST]
    for k in range(1, chain[COUNT] + 1):
        cells[k] = at
        at = _next(arrays.lattice, cells[k - 1], at)
    cells[chain[COUNT] + 1] = arrays.vertices[chain[B], CELL]
    return _without_stairs(arrays.lattice, cells)


@kernel
def _without_stairs(lattice: Lattice, cells: Cells) -> Cells:
    """Cells without those between two that touch at a corner."""
    count = 1
    k = 1
    while k < cells.size:
        if k + 1 < cells.size and _is_diagonal(lattice, cells[count - 1], cells[k + 1]):
            k += 1
        cells[count] = cells[k]
        count += 1
        k += 1
    return cells[:count].copy()


@inlined
def _is_diagonal(lattice: Lattice, one: int, other: int) -> bool:
    rows = row_of(lattice, one) - row_of(lattice, other)
    cols = col_of(lattice, one) - col_of(lattice, other)
    return abs(rows) == 1 and abs(cols) == 1


@kernel
def path_length(lattice: Lattice, cells: Cells) -> float:
    """Length of a path of adjacent cells, in cells."""
    length = 0.0
    for k in range(1, cells.size):
        length += np.sqrt(2.0) if _is_diagonal(lattice, cells[k - 1], cells[k]) else 1.0
    return length


@kernel
def components(arrays: Arrays) -> Cells:
    """Number of the connected part of each vertex (V,), from 0 on; NONE for unused rows."""
    part = np.full(len(arrays.vertices), NONE, dtype=np.int64)
    stack = np.empty(len(arrays.vertices), dtype=np.int64)
    number = 0
    for start in range(part.size):
        if arrays.vertices[start, CELL] == NONE or part[start] != NONE:
            continue
        part[start] = number
        stack[0] = start
        count = 1
        while count > 0:
            count -= 1
            vertex = stack[count]
            for chain in arrays.vertices[vertex, SLOT:]:
                if chain == NONE:
                    continue
                other = arrays.chains[chain, A] + arrays.chains[chain, B] - vertex
                if part[other] == NONE:
                    part[other] = number
                    stack[count] = other
                    count += 1
        number += 1
    return part
