"""A skeleton drawn on cells, followed from node to node: compiled loops only."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.jit import inlined, kernel

Cells = NDArray[np.int64]
Raster = NDArray[np.uint8]


def _ring(code: int) -> list[int]:
    return [(code >> k) & 1 for k in range(8)]


def _crossings() -> NDArray[np.int64]:
    """Rises 0 -> 1 round the eight neighbours, for all 256 of them.

    Bit k: neighbour k, clockwise from north.
    """
    rings = (_ring(code) for code in range(256))
    return np.array([sum(a < b for a, b in pairwise([*r, r[0]])) for r in rings], dtype=np.int64)


def _redundant() -> NDArray[np.bool_]:
    """Neighbourhoods whose centre can go.

    That is two or more neighbours that hang together, over edges or corners, without it. Yokoi's
    connectivity number for eight-joined cells counts the gaps that are closed by an edge neighbour.
    """
    table = np.zeros(256, dtype=np.bool_)
    for code in range(256):
        off = [1 - bit for bit in _ring(code)]
        number = sum(off[k] - off[k] * off[k + 1] * off[(k + 2) % 8] for k in (0, 2, 4, 6))
        table[code] = number == 1 and 8 - sum(off) >= 2
    return table


_CROSSINGS = _crossings()
_REDUNDANT = _redundant()


@inlined
def _code(raster: Raster, row: int, col: int) -> int:
    """The eight neighbours as bits, clockwise from north."""
    code: np.int64 = np.int64(raster[row - 1, col] != 0)
    code |= np.int64(raster[row - 1, col + 1] != 0) << 1
    code |= np.int64(raster[row, col + 1] != 0) << 2
    code |= np.int64(raster[row + 1, col + 1] != 0) << 3
    code |= np.int64(raster[row + 1, col] != 0) << 4
    code |= np.int64(raster[row + 1, col - 1] != 0) << 5
    code |= np.int64(raster[row, col - 1] != 0) << 6
    code |= np.int64(raster[row - 1, col - 1] != 0) << 7
    return int(code)


@inlined
def _steps(cols: int) -> Cells:
    """Index steps to the eight neighbours.

    Those over an edge come first, so that walks prefer them.
    """
    return np.array([-cols, 1, cols, -1, -cols + 1, cols + 1, cols - 1, -cols - 1], dtype=np.int64)


@kernel
def clean(
    raster: Raster, pinned: Raster, crossings: Cells, redundant: NDArray[np.bool_]
) -> tuple[Raster, Cells]:
    """Make a skeleton one cell wide, cell by cell, so that staircases are not taken for branches.

    raster, pinned (H, W) uint8 with an empty border; pinned cells stay. Returns, as rasters of the
    same shape: 0 empty, 1 passage (two neighbours), 2 junction (three or more), 3 end or lone cell,
    4 pinned; and the list of flat indices of all cells left.
    """
    cols = raster.shape[1]
    kinds = raster.copy()
    cells = np.flatnonzero(kinds)
    left = -1
    while left != cells.size:
        left = cells.size
        count = 0
        for at in cells:
            row = at // cols
            col = at % cols
            if not pinned[row, col] and redundant[_code(kinds, row, col)]:
                kinds[row, col] = 0
            else:
                cells[count] = at
                count += 1
        cells = cells[:count]
    flat = kinds.ravel()
    steps = _steps(cols)
    for at in cells:
        neighbours = 0
        for step in steps:
            neighbours += flat[at + step] != 0
        flat[at] = 1 if neighbours == 2 else (2 if neighbours > 2 else 3)
        if pinned[at // cols, at % cols]:
            flat[at] = 4
    return kinds, cells


@kernel
def place_nodes(
    kinds: Raster, cells: Cells, crossings: Cells
) -> tuple[Cells, NDArray[np.int32], Cells]:
    """One node for each end, pinned cell and cluster of junction cells.

    Returns the nodes' flat cell indices (N,); the node number + 1 of each of their cells, (H * W,);
    and for each junction cell the next cell on its way to the node's own, (H * W,). A cluster's own
    cell has three or more crossings, if any has, and is the nearest such to the cluster's middle.
    """
    cols = kinds.shape[1]
    flat = kinds.ravel()
    steps = _steps(cols)
    owner = np.zeros(flat.size, dtype=np.int32)
    parent = np.full(flat.size, -1, dtype=np.int64)
    nodes = np.empty(cells.size, dtype=np.int64)
    queue = np.empty(cells.size, dtype=np.int64)
    count = 0
    for at in cells:
        if flat[at] == 1 or owner[at]:
            continue
        count += 1
        owner[at] = count
        queue[0] = at
        size = 1
        head = 0
        while flat[at] == 2 and head < size:
            for step in steps:
                to = queue[head] + step
                if flat[to] == 2 and not owner[to]:
                    owner[to] = count
                    queue[size] = to
                    size += 1
            head += 1
        row = (queue[:size] // cols).mean()
        col = (queue[:size] % cols).mean()
        best = at
        best_score = np.inf
        for cell in queue[:size]:
            score = (cell // cols - row) ** 2 + (cell % cols - col) ** 2
            score += 1e6 if crossings[_code(kinds, cell // cols, cell % cols)] < 3 else 0.0
            if score < best_score:
                best = cell
                best_score = score
        nodes[count - 1] = best
        parent[best] = best
        queue[0] = best
        size = 1
        head = 0
        while head < size:
            for step in steps:
                to = queue[head] + step
                if owner[to] == count and parent[to] < 0:
                    parent[to] = queue[head]
                    queue[size] = to
                    size += 1
            head += 1
    return nodes[:count], owner, parent


@kernel
def follow(
    kinds: Raster, cells: Cells, nodes: Cells, owner: NDArray[np.int32], parent: Cells
) -> tuple[Cells, Cells, Cells, Cells]:
    """Walk along all passages between nodes; a ring without node gets one.

    Returns the nodes, longer by those of rings; the chains' end nodes (M, 2); where each chain
    starts in the flat list of cells, (M + 1,); and that list, node cells included.
    """
    cols = kinds.shape[1]
    flat = kinds.ravel()
    steps = _steps(cols)
    walked = np.zeros(flat.size, dtype=np.bool_)
    all_nodes = np.empty(cells.size, dtype=np.int64)
    all_nodes[: nodes.size] = nodes
    count = nodes.size
    ends = np.empty((4 * cells.size + 1, 2), dtype=np.int64)
    starts = np.zeros(4 * cells.size + 2, dtype=np.int64)
    path = np.empty(8 * cells.size + 64, dtype=np.int64)
    scratch = np.empty(cells.size + 1, dtype=np.int64)
    links = np.empty((4 * cells.size + 1, 2), dtype=np.int64)
    linked = 0
    chains = length = 0
    for ring in range(2):
        for start in cells:
            if ring and (flat[start] != 1 or walked[start]):
                continue
            if ring:
                all_nodes[count] = start
                count = count + 1
                owner[start] = count
                parent[start] = start
                walked[start] = True
            elif not owner[start]:
                continue
            for step in steps:
                cell = start + step
                passage = flat[cell] == 1 and not walked[cell] and not owner[cell]
                # Nodes side by side are joined once: from the lower number, and by the first pair
                # of cells found.
                beside = owner[cell] > owner[start] and not _joined(
                    links[:linked], owner[start], owner[cell]
                )
                if not passage and not beside:
                    continue
                if beside:
                    links[linked, 0] = owner[start]
                    links[linked, 1] = owner[cell]
                    linked += 1
                if path.size - length < 3 * cells.size:
                    path = np.concatenate((path, np.empty(path.size, dtype=np.int64)))
                length = _way_to_node(parent, start, path, length, scratch)
                cell, length = _through(flat, owner, walked, steps, (start, cell), path, length)
                size = _climb(parent, cell, scratch, 0)
                path[length : length + size] = scratch[:size]
                length += size
                ends[chains] = owner[start] - 1, owner[cell] - 1
                chains += 1
                starts[chains] = length
    return all_nodes[:count], ends[:chains], starts[: chains + 1], path[:length]


@inlined
def _through(
    flat: NDArray[np.uint8],
    owner: NDArray[np.int32],
    walked: NDArray[np.bool_],
    steps: Cells,
    first: tuple[int, int],
    path: Cells,
    length: int,
) -> tuple[int, int]:
    """Walk from one cell to the next and on along a passage to a node, written into the path.

    Returns where, and its length.
    """
    before, cell = first
    while not owner[cell]:
        walked[cell] = True
        path[length] = cell
        length += 1
        following = -1
        for turn in steps:
            to = cell + turn
            if (
                flat[to]
                and to != before
                and (following < 0 or (owner[to] and not owner[following]))
            ):
                following = to
        before = cell
        cell = following
    return cell, length


@inlined
def _joined(links: Cells, a: int, b: int) -> bool:
    return bool(np.any((links[:, 0] == a) & (links[:, 1] == b)))


@inlined
def _climb(parent: Cells, cell: int, out: Cells, size: int) -> int:
    """Append the way from a node's outer cell to the node's own."""
    out[size] = cell
    size += 1
    while parent[cell] != cell:
        cell = parent[cell]
        out[size] = cell
        size += 1
    return size


@inlined
def _way_to_node(parent: Cells, cell: int, path: Cells, length: int, scratch: Cells) -> int:
    """Append the way from a node's own cell to an outer cell of it."""
    size = _climb(parent, cell, scratch, 0)
    for k in range(size):
        path[length + k] = scratch[size - 1 - k]
    return length + size


def trace(
    raster: NDArray[np.bool_], pinned: NDArray[np.bool_] | None = None
) -> tuple[Cells, Cells, Cells, Cells]:
    """Nodes and chains of a skeleton.

    raster, pinned (H, W) bool; pinned cells become nodes whatever is round them. Returns node cells
    (N, 2) as (row, col), end nodes of each chain (M, 2), where each chain's cells start (M + 1,) in
    the list that comes last, and that list (K, 2): from the one node's cell to the other's, chain
    after chain.
    """
    framed = np.zeros((raster.shape[0] + 2, raster.shape[1] + 2), dtype=np.uint8)
    framed[1:-1, 1:-1] = raster
    held = np.zeros_like(framed)
    if pinned is not None:
        held[1:-1, 1:-1] = pinned
        framed |= held
    kinds, cells = clean(framed, held, _CROSSINGS, _REDUNDANT)
    nodes, owner, parent = place_nodes(kinds, cells, _CROSSINGS)
    nodes, ends, starts, path = follow(kinds, cells, nodes, owner, parent)
    cols = framed.shape[1]
    path_cells = np.stack([path // cols - 1, path % cols - 1], axis=1)
    node_cells = np.stack([nodes // cols - 1, nodes % cols - 1], axis=1)
    return node_cells, ends, starts, path_cells
