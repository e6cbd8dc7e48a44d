"""Which vertices of the skeleton graph are nodes: spurs are pruned, close branches are merged.

All of it is computed from the whole graph each time it has changed, on chains and not on cells:
some microseconds for a floor. So it does not depend on what the graph was before.
"""

import math
from typing import NamedTuple

import numpy as np

from thinmap_ros.core.se2 import Array, Cells, Mask
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.layers.free_space import borders_unknown, squared_clearance
from thinmap_ros.core.topology.layers.lattice import col_of, hash_of, key_of, row_of
from thinmap_ros.core.topology.layers.skeleton_graph import (
    CELL,
    HASH,
    MAX_DEGREE,
    NONE,
    SLOT,
    A,
    Arrays,
    B,
    chain_cells,
)
from thinmap_ros.jit import inlined, kernel

# Columns of `measured`: the cell that it was measured at, its squared clearance, and whether its
# free space borders unknown cells (NONE: not known yet).
SQUARED = 1
BORDERS_UNKNOWN = 2
COLUMNS = 3
_END = 1
_BRANCH = 3
# Branch nodes closer than this along the skeleton are one, at wide junctions.
_BRANCH_MERGE_M = 0.4


class Limits(NamedTuple):
    """Lengths in cells: robot radius, min_branch_length, edges that are merged; and the ratio."""

    radius: float
    branch_length: float
    merge_distance: float
    branch_ratio: float

    @staticmethod
    def of(config: TopologyConfig, resolution_m: float) -> 'Limits':
        """Limits of a configuration on cells of an edge, m."""
        return Limits(
            config.robot_radius_m / resolution_m,
            config.min_branch_length_m / resolution_m,
            _BRANCH_MERGE_M / resolution_m,
            config.min_branch_ratio,
        )


class Paths(NamedTuple):
    """Paths between nodes along the chains that are kept.

    ends (P, 2): vertices; chains[start[p] : start[p + 1]]: from the first to the second; node (V,):
    the vertex that represents a vertex, NONE where there is no node; up (V,): the path that leads
    one step towards it. hashes (P,); edges (E,): the paths that are edges.
    """

    ends: Cells
    start: Cells
    chains: Cells
    lengths: Array
    hashes: Cells
    node: Cells
    up: Cells
    edges: Cells


@kernel
def measure(arrays: Arrays, measured: Cells, box: Cells) -> None:
    """Update the clearances (V, 3) of new vertices, and where cells changed within their reach.

    box: first row, first column, last row, last column of the cells that changed.
    """
    lattice = arrays.lattice
    for vertex in range(len(arrays.vertices)):
        cell = arrays.vertices[vertex, CELL]
        if cell == NONE:
            continue
        row = row_of(lattice, cell)
        col = col_of(lattice, cell)
        rows = max(box[0] - row, row - box[2], 0)
        cols = max(box[1] - col, col - box[3], 0)
        reach = math.sqrt(measured[vertex, SQUARED]) + 4.0
        if measured[vertex, CELL] != cell or rows * rows + cols * cols <= reach * reach:
            measured[vertex, CELL] = cell
            measured[vertex, SQUARED] = squared_clearance(lattice, cell)
            measured[vertex, BORDERS_UNKNOWN] = NONE


@kernel
def prune(arrays: Arrays, measured: Cells, limits: Limits) -> tuple[Mask, Cells]:
    """Which chains (C,) are kept, and how many of them each vertex (V,) has; NONE: pruned.

    A spur is the path from an end to the first branch. What it adds is the length by which the
    space around its tip reaches beyond the space around its base: length + room(tip) - room(base),
    room being clearance less robot radius. Up to min_branch_length that is noise; and where the tip
    sees known walls only, up to min_branch_ratio of the base's room, too (a right-angled corner of
    a room adds 0.41 of it). All spurs of a round are pruned at once, so that the two corners at the
    end of a corridor leave its middle.
    """
    alive = arrays.chains[:, A] != NONE
    degree = np.full(len(arrays.vertices), NONE, dtype=np.int64)
    for vertex in range(degree.size):
        if arrays.vertices[vertex, CELL] != NONE:
            degree[vertex] = np.sum(arrays.vertices[vertex, SLOT:] != NONE)
    tips = np.empty(degree.size, dtype=np.int64)
    bases = np.empty(degree.size, dtype=np.int64)
    while True:
        count = 0
        for tip in range(degree.size):
            if degree[tip] != _END:
                continue
            base, length = _base(arrays, alive, degree, tip)
            if degree[base] == _END and _is_later(arrays, measured, tip, base):
                continue
            if _is_noise(arrays, measured, limits, tip, base, length):
                tips[count] = tip
                bases[count] = base
                count += 1
        if count == 0:
            return alive, degree
        for k in range(count):
            _remove_spur(arrays, alive, degree, tips[k], bases[k])


@inlined
def _is_later(arrays: Arrays, measured: Cells, tip: int, base: int) -> bool:
    """Of two ends of one path, whether the other one is pruned first."""
    room = measured[tip, SQUARED]
    other_room = measured[base, SQUARED]
    if room != other_room:
        return bool(room > other_room)
    key = key_of(arrays.lattice, arrays.vertices[tip, CELL])
    return bool(key > key_of(arrays.lattice, arrays.vertices[base, CELL]))


@inlined
def _is_noise(
    arrays: Arrays, measured: Cells, limits: Limits, tip: int, base: int, length: float
) -> bool:
    """Whether a spur adds too little; see `prune`."""
    room = math.sqrt(measured[base, SQUARED]) - limits.radius
    adds = length + math.sqrt(measured[tip, SQUARED]) - limits.radius - room
    if adds <= limits.branch_length:
        return True
    if adds > limits.branch_ratio * room:
        return False
    if measured[tip, BORDERS_UNKNOWN] == NONE:
        measured[tip, BORDERS_UNKNOWN] = borders_unknown(
            arrays.lattice, arrays.vertices[tip, CELL], measured[tip, SQUARED]
        )
    return bool(measured[tip, BORDERS_UNKNOWN] == 0)


@inlined
def _remove_spur(arrays: Arrays, alive: Mask, degree: Cells, tip: int, base: int) -> None:
    vertex = tip
    while vertex != base:
        number = _other_chain(arrays, alive, vertex, NONE)
        alive[number] = False
        degree[vertex] = NONE
        vertex = arrays.chains[number, A] + arrays.chains[number, B] - vertex
    degree[base] -= 1


@inlined
def _other_chain(arrays: Arrays, alive: Mask, vertex: int, came: int) -> int:
    """A kept chain at a vertex other than the one that was followed to it."""
    for number in arrays.vertices[vertex, SLOT:]:
        if number != NONE and alive[number] and number != came:
            return int(number)
    return came


@inlined
def _base(arrays: Arrays, alive: Mask, degree: Cells, tip: int) -> tuple[int, float]:
    """Vertex at which the path from a tip branches or ends, and its length."""
    vertex = tip
    number = NONE
    length = 0.0
    while True:
        number = _other_chain(arrays, alive, vertex, number)
        length += arrays.lengths[number]
        vertex = arrays.chains[number, A] + arrays.chains[number, B] - vertex
        if degree[vertex] != 2:
            return vertex, length


@kernel
def find_paths(
    arrays: Arrays, measured: Cells, alive: Mask, degree: Cells, merge_distance: float
) -> Paths:
    """Nodes and the paths between them; a ring without nodes has one at its first vertex."""
    used = ~alive
    most = int(np.sum(alive))
    ends = np.empty((most, 2), dtype=np.int64)
    start = np.zeros(most + 1, dtype=np.int64)
    order = np.empty(most, dtype=np.int64)
    lengths = np.zeros(most)
    hashes = np.zeros(most, dtype=np.int64)
    node = np.full(degree.size, NONE, dtype=np.int64)
    at_vertex = np.full((degree.size, MAX_DEGREE), NONE, dtype=np.int64)
    count = 0
    for ring in range(2):
        for some in range(degree.size):
            vertex = some
            if degree[vertex] < 0 or ring != (degree[vertex] == 2):
                continue
            if ring:
                vertex = _first_of_ring(arrays, used, vertex)
                if vertex == NONE:
                    continue
            node[vertex] = vertex
            for slot in range(MAX_DEGREE):
                number = arrays.vertices[vertex, SLOT + slot]
                if number == NONE or used[number]:
                    continue
                ends[count, 0] = vertex
                size = start[count]
                to = vertex
                while True:
                    used[number] = True
                    order[size] = number
                    size += 1
                    lengths[count] += arrays.lengths[number]
                    hashes[count] += arrays.chains[number, HASH]
                    to = arrays.chains[number, A] + arrays.chains[number, B] - to
                    following = _other_chain(arrays, alive, to, number)
                    if degree[to] != 2 or to == vertex or used[following]:
                        break
                    number = following
                ends[count, 1] = to
                for end in (vertex, to):
                    for place in range(MAX_DEGREE):
                        if at_vertex[end, place] == NONE:
                            at_vertex[end, place] = count
                            break
                count += 1
                start[count] = size
    up = _merge_branches(
        arrays,
        measured,
        degree,
        merge_distance,
        (ends[:count], lengths[:count], hashes[:count]),
        node,
        at_vertex,
    )
    known = (ends[:count], lengths[:count], hashes[:count])
    edges, total = _edges_of(known, node, up, merge_distance)
    return Paths(ends[:count], start[: count + 1], order, lengths[:count], total, node, up, edges)


@kernel
def _edges_of(
    paths: tuple[Cells, Array, Cells], node: Cells, up: Cells, merge_distance: float
) -> tuple[Cells, Cells]:
    """Paths that are edges, and the hashes of all paths with those that lead to their nodes."""
    ends, lengths, hashes = paths
    edges = np.empty(lengths.size, dtype=np.int64)
    kept = 0
    total = hashes.copy()
    for p in range(lengths.size):
        a = ends[p, 0]
        b = ends[p, 1]
        is_short = lengths[p] <= merge_distance
        is_within = node[a] == node[b] and (up[a] == p or up[b] == p or is_short)
        if (a == b and not is_short) or not is_within:
            edges[kept] = p
            kept += 1
            for end in (a, b):
                vertex = end
                while node[vertex] != vertex:
                    total[p] += hashes[up[vertex]]
                    vertex = ends[up[vertex], 0] + ends[up[vertex], 1] - vertex
    return edges[:kept], total


@kernel
def _first_of_ring(arrays: Arrays, used: Mask, vertex: int) -> int:
    """The vertex of a ring with the first cell by its key; NONE if the ring has been followed."""
    number = NONE
    for some in arrays.vertices[vertex, SLOT:]:
        if some != NONE and not used[some]:
            number = some
    if number == NONE:
        return NONE
    best = vertex
    to = vertex
    while True:
        to = arrays.chains[number, A] + arrays.chains[number, B] - to
        key = key_of(arrays.lattice, arrays.vertices[to, CELL])
        if key < key_of(arrays.lattice, arrays.vertices[best, CELL]):
            best = to
        if to == vertex:
            return best
        for some in arrays.vertices[to, SLOT:]:
            if some != NONE and not used[some] and some != number:
                number = some
                break


@kernel
def _ranked(arrays: Arrays, measured: Cells, branches: Cells) -> Cells:
    """Branches, the one with the largest clearance first, then by the keys of their cells."""
    keys = np.empty(branches.size, dtype=np.int64)
    for k in range(branches.size):
        keys[k] = key_of(arrays.lattice, arrays.vertices[branches[k], CELL])
    by_key = branches[np.argsort(keys)]
    return by_key[np.argsort(-measured[by_key, SQUARED], kind='mergesort')]


@kernel
def _merge_branches(
    arrays: Arrays,
    measured: Cells,
    degree: Cells,
    merge_distance: float,
    paths: tuple[Cells, Array, Cells],
    node: Cells,
    at_vertex: Cells,
) -> Cells:
    """Let branches represent those within a distance along paths.

    paths: their ends, lengths and hashes. Writes into `node`; returns the path to take from each
    vertex that is represented by another.
    """
    ends, lengths, hashes = paths
    up = np.full(degree.size, NONE, dtype=np.int64)
    free = degree >= _BRANCH
    distance = np.full(degree.size, np.inf)
    stack = np.empty(16 * degree.size + 64, dtype=np.int64)
    for root in _ranked(arrays, measured, np.flatnonzero(degree >= _BRANCH)):
        if not free[root]:
            continue
        free[root] = False
        distance[root] = 0.0
        stack[0] = root
        count = 1
        while count > 0:
            count -= 1
            vertex = stack[count]
            for p in at_vertex[vertex]:
                if p == NONE:
                    continue
                to = ends[p, 0] + ends[p, 1] - vertex
                length = distance[vertex] + lengths[p]
                is_mine = node[to] == root and to != root
                is_shorter = length < distance[to] or (
                    length == distance[to] and up[to] != NONE and hashes[p] < hashes[up[to]]
                )
                if length <= merge_distance and (free[to] or (is_mine and is_shorter)):
                    free[to] = False
                    distance[to] = length
                    node[to] = root
                    up[to] = p
                    if count < stack.size:
                        stack[count] = to
                        count += 1
    return up


@kernel
def edge_cells(arrays: Arrays, paths: Paths, p: int) -> Cells:
    """Cells of an edge from node to node, always from the same end."""
    lattice = arrays.lattice
    a = paths.ends[p, 0]
    b = paths.ends[p, 1]
    before = _to_node(arrays, paths, a)
    after = _to_node(arrays, paths, b)
    cells = np.concatenate((before[::-1], _path_cells(arrays, paths, p, a)[1:], after[1:]))
    last = cells.size - 1
    first_key = key_of(lattice, cells[0])
    last_key = key_of(lattice, cells[last])
    is_turned = key_of(lattice, cells[1]) > key_of(lattice, cells[last - 1])
    if first_key > last_key or (first_key == last_key and is_turned):
        return cells[::-1].copy()
    return cells


@kernel
def _to_node(arrays: Arrays, paths: Paths, vertex: int) -> Cells:
    """Cells from a vertex to the one that represents it."""
    cells = np.full(1, arrays.vertices[vertex, CELL], dtype=np.int64)
    while paths.node[vertex] != vertex:
        p = paths.up[vertex]
        cells = np.concatenate((cells, _path_cells(arrays, paths, p, vertex)[1:]))
        vertex = paths.ends[p, 0] + paths.ends[p, 1] - vertex
    return cells


@kernel
def _path_cells(arrays: Arrays, paths: Paths, p: int, vertex: int) -> Cells:
    """Cells of a path that starts at one of its ends."""
    at = paths.ends[p, 0]
    cells = np.full(1, arrays.vertices[at, CELL], dtype=np.int64)
    for k in range(paths.start[p], paths.start[p + 1]):
        number = paths.chains[k]
        part = chain_cells(arrays, number)
        if arrays.chains[number, A] != at:
            part = part[::-1].copy()
        cells = np.concatenate((cells, part[1:]))
        at = arrays.chains[number, A] + arrays.chains[number, B] - at
    return cells if paths.ends[p, 0] == vertex else cells[::-1].copy()


@kernel
def node_hash(arrays: Arrays, cell: int) -> int:
    """Hash of a node without edges, among those of edges."""
    return hash_of(arrays.lattice, cell)
