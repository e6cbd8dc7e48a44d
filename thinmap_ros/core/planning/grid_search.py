"""How far it is over the grid from one place to many: lengths of ways only, fast enough to ask all the time.

Chamfer steps of 5 and 7 (a fifth of a cell) in a circular bucket queue; ways are at most 8 % longer than the straight
line. Source: Dial, "Algorithm 360: shortest-path forest with topological ordering", 1969; Borgefors, "Distance
transformations in digital images", 1986.
"""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.se2 import Array

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
Key = tuple[int, int]
_STRAIGHT, _DIAGONAL, _BUCKETS = 5, 7, 8
_FAR = 2**31 - 1


def ways_from(allowed: Mask, start: tuple[int, int], goals: Cells) -> Array:
    """Length, in cells, of the way over allowed cells (H, W) from a start (row, col) to each goal (N, 2), (N,).

    inf where there is none, and where a goal is not allowed. A start that is not allowed may be left all the same.
    """
    steps = _ways_from(allowed, start[0], start[1], np.ascontiguousarray(goals, dtype=np.int64))
    return np.where(steps == _FAR, np.inf, steps / _STRAIGHT)


def coarse(allowed: Mask, factor: int) -> Mask:
    """Squares of factor x factor cells of a mask (H, W) in which any is set, (ceil(H / factor), ceil(W / factor))."""
    return np.asarray(_coarse(allowed, factor, 0, 0))


class WayTable:
    """Ways between places of a map that grows, on a coarse grid, remembered for a while: most places stay."""

    def __init__(self, cell_m: float, forget_s: float) -> None:
        self._cell_m = cell_m
        self._forget_ns = forget_s * 1e9
        self._known: dict[frozenset[Key], tuple[int, float]] = {}

    def update(self, allowed: Mask, frame: GridFrame, places: Array, stamp_ns: int) -> Array:
        """Lengths of the ways, m, between all places (N, 2), m, over the allowed cells (H, W) of a frame, (N, N).

        inf where there is none.
        """
        factor = max(1, round(self._cell_m / frame.resolution))
        # Squares on a lattice that stays when the frame grows.
        shift = [round(origin / frame.resolution) % factor for origin in (frame.origin_y, frame.origin_x)]
        ways = _coarse(allowed, factor, shift[0], shift[1])
        cells = (frame.cells_of(places) + shift) // factor
        first = (round(frame.origin_y / frame.resolution) // factor, round(frame.origin_x / frame.resolution) // factor)
        keys = [(int(row), int(col)) for row, col in cells + first]
        pairs = {frozenset((a, b)) for i, a in enumerate(keys) for b in keys[:i]}
        self._known = {
            pair: known for pair, known in self._known.items()
            if pair in pairs and stamp_ns - known[0] < self._forget_ns
        }
        for i, key in enumerate(keys):
            missing = [j for j in range(i) if keys[j] != key and frozenset((key, keys[j])) not in self._known]
            if missing:
                found = ways_from(ways, (int(cells[i, 0]), int(cells[i, 1])), cells[missing])
                for j, way in zip(missing, (found * frame.resolution * factor).tolist(), strict=True):
                    self._known[frozenset((key, keys[j]))] = (stamp_ns, way)
        return np.array([[0.0 if a == b else self._known[frozenset((a, b))][1] for b in keys] for a in keys])


@kernel
def _coarse(allowed: Mask, factor: int, shift_row: int, shift_col: int) -> Mask:
    """Squares in which any cell is set; the first cell is (shift_row, shift_col) within its square."""
    rows, cols = allowed.shape
    squares = np.zeros((-(-(rows + shift_row) // factor), -(-(cols + shift_col) // factor)), dtype=np.bool_)
    for row in range(rows):
        line = squares[(row + shift_row) // factor]
        square, within = 0, shift_col
        for col in range(cols):
            if within == factor:
                square, within = square + 1, 0
            line[square] |= allowed[row, col]
            within += 1
    return squares


@kernel
def _ways_from(allowed: Mask, start_row: int, start_col: int, goals: Cells) -> NDArray[np.int32]:
    rows, cols = allowed.shape
    steps = np.full((rows, cols), _FAR, dtype=np.int32)
    wanted = np.zeros((rows, cols), dtype=np.bool_)
    left = 0
    for i in range(goals.shape[0]):
        row, col = goals[i, 0], goals[i, 1]
        if 0 <= row < rows and 0 <= col < cols and allowed[row, col] and not wanted[row, col]:
            wanted[row, col] = True
            left += 1
    capacity = 2 * rows * cols + 1
    queue = np.empty((_BUCKETS, capacity), dtype=np.int32)
    counts = np.zeros(_BUCKETS, dtype=np.int64)
    steps[start_row, start_col] = 0
    queue[0, 0], counts[0] = start_row * cols + start_col, 1
    now, waiting = 0, 1
    while waiting > 0 and left > 0:
        bucket = now % _BUCKETS
        while counts[bucket] > 0:
            counts[bucket] -= 1
            waiting -= 1
            cell = queue[bucket, counts[bucket]]
            row, col = cell // cols, cell % cols
            if steps[row, col] != now:
                continue
            if wanted[row, col]:
                wanted[row, col] = False
                left -= 1
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(col - 1, 0), min(col + 2, cols)):
                    # No corner is cut: a diagonal step needs both cells beside it.
                    if not allowed[r, c] or not (allowed[r, col] or r == row) or not (allowed[row, c] or c == col):
                        continue
                    reached = now + (_STRAIGHT if r == row or c == col else _DIAGONAL)
                    if reached < steps[r, c] and counts[reached % _BUCKETS] < capacity:
                        steps[r, c] = reached
                        queue[reached % _BUCKETS, counts[reached % _BUCKETS]] = r * cols + c
                        counts[reached % _BUCKETS] += 1
                        waiting += 1
        now += 1
    found = np.full(goals.shape[0], _FAR, dtype=np.int32)
    for i in range(goals.shape[0]):
        row, col = goals[i, 0], goals[i, 1]
        if 0 <= row < rows and 0 <= col < cols and allowed[row, col] and not wanted[row, col]:
            found[i] = steps[row, col]
    return found
