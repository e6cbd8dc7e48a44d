"""The robot's working memory.

The last windows of the grid, on one lattice, in a square that moves along.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.frame import MAX_RESOLUTION_M, MIN_RESOLUTION_M, GridFrame
from thinmap_ros.core.grid.patch import FREE_AT_MOST, OCCUPIED_AT_LEAST, UNKNOWN, GridPatch
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.snapshot import MAX_CELL_INDEX, MAX_COORDINATE_M, Field
from thinmap_ros.core.topology.atlas import Box
from thinmap_ros.core.topology.config import TopologyConfig

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
States = NDArray[np.int8]
FREE = np.int8(0)
OCCUPIED = np.int8(100)
_NEVER = np.int8(-2)  # never in a window, or forgotten
_BLOCK = 3  # painting looks first at blocks of 2**3 cells
FIELDS = {
    'memory': Field(np.int8, ('s', 's'), int(_NEVER), int(OCCUPIED)),
    'low': Field(np.int64, (2,), -MAX_CELL_INDEX, MAX_CELL_INDEX),
    'lattice': Field(
        np.float64,
        (3,),
        (-MAX_COORDINATE_M, -MAX_COORDINATE_M, MIN_RESOLUTION_M),
        (MAX_COORDINATE_M, MAX_COORDINATE_M, MAX_RESOLUTION_M),
    ),
    'reach': Field(np.int64, (), 0, MAX_CELL_INDEX),
}
_OFF_LATTICE = 1e-3  # of a cell: windows that lie worse than this do not belong to the same grid


class Surroundings:
    """What the windows of the last places showed, within window_memory_m round the newest one.

    Bounded, whatever the map.

    Thinning near the rim of a window differs from thinning the whole map. With what lies round the
    window at hand, update_context_m wide, the skeleton goes on over its rim as it would in a map of
    the whole. The cells are kept in a square array whose indices wrap round, so that nothing is
    moved when the robot moves.

    `near` is the near part of the window, `inner` that part or all of it, whichever is to be
    thinned now, and `box` the same with its context.
    """

    def __init__(self, lattice: GridFrame, window: tuple[int, int], config: TopologyConfig) -> None:
        """Begin on the cells of a lattice, for windows of at most so many rows and columns."""
        resolution = lattice.resolution
        self.lattice = lattice
        self._margin = round(config.update_context_m / resolution)
        self._near = round(config.update_window_m / resolution)
        self._depth = round(config.skeleton_keep_margin_m / resolution)
        self._reach = _reach(config, resolution)
        self._size = max(window) + 2 * self._reach
        self._memory: States = np.full((self._size, self._size), _NEVER, dtype=np.int8)
        self._low = (0, 0)
        self.box = self.inner = self.near = Box(0, 0, 1, 1)
        self._cells: States = np.full((1, 1), _NEVER, dtype=np.int8)

    def take(self, window: GridPatch, wide: bool) -> None:
        """Move to a new window and take its cells over.

        wide: all of it is to be thinned, not the near part only. Raises InputError where its cells
        do not lie on those of the first window, or it is larger than that one was.
        """
        row, col = self._place_of(window.frame)
        whole = Box(row, col, *window.shape)
        if max(window.shape) + 2 * self._margin > self._size:
            raise InputError(f'window of {window.shape} cells: expected the size of the first one')
        self._move_to(row, col, window.shape)
        states = _states(np.ascontiguousarray(window.cells))
        for cells, memory in self._parts(whole):
            self._memory[memory] = states[cells]
        self.near = whole.middle(self._near)
        self.inner = whole if wide else self.near
        self.box = self.inner.grown(self._margin)
        self._cells = np.empty((self.box.rows, self.box.cols), dtype=np.int8)
        for cells, memory in self._parts(self.box):
            self._cells[cells] = self._memory[memory]

    def state(self) -> dict[str, NDArray[Any]]:
        """What is remembered, and where, as arrays."""
        return {
            'memory': self._memory.copy(),
            'low': np.array(self._low),
            'lattice': self.lattice.as_array(),
            'reach': np.array(self._reach),
        }

    @staticmethod
    def from_state(state: Mapping[str, NDArray[Any]], config: TopologyConfig) -> 'Surroundings':
        """What another one's `state` describes.

        state: checked by FIELDS. Raises InputError where it does not fit the configuration.
        """
        memory = state['memory']
        reach = int(state['reach'])
        lattice = GridFrame(*state['lattice'].tolist())
        wanted = _reach(config, lattice.resolution)
        expected = f'{wanted} (window_memory_m, update_context_m)'
        snapshot.require(reach == wanted, f'surroundings {reach} cells wide', expected)
        window = memory.shape[0] - 2 * reach
        snapshot.require(window > 0, f'surroundings {memory.shape}', f'more than {2 * reach} cells')
        known = np.isin(memory, np.array([_NEVER, UNKNOWN, FREE, OCCUPIED]))
        snapshot.require(bool(known.all()), 'surroundings: memory', '-2, -1, 0 or 100')
        around = Surroundings(lattice, (window, window), config)
        around._memory = memory
        around._low = (int(state['low'][0]), int(state['low'][1]))
        return around

    def _move_to(self, row: int, col: int, shape: tuple[int, int]) -> None:
        """Put the remembered square round a window, and forget what it has left behind."""
        low = (row - (self._size - shape[0]) // 2, col - (self._size - shape[1]) // 2)
        for axis in (0, 1):
            step = low[axis] - self._low[axis]
            count = min(abs(step), self._size)
            first = low[axis] + self._size - count if step > 0 else low[axis]
            for _, lines in _wrapped(first, count, self._size):
                self._memory[lines if axis == 0 else (slice(None), lines)] = _NEVER
        self._low = low

    def _parts(self, box: Box) -> list[tuple[tuple[slice, slice], tuple[slice, slice]]]:
        """The up to four blocks of a rectangle: where they lie in it, and where in the memory."""
        rows = _wrapped(box.row, box.rows, self._size)
        cols = _wrapped(box.col, box.cols, self._size)
        return [((r, c), (at_r, at_c)) for r, at_r in rows for c, at_c in cols]

    def redrawn(self, painted: Mask) -> Mask:
        """Where the new skeleton takes the old one's place.

        This is the inner part, away from places known but not remembered. painted (H, W): from
        `patch`. There the new skeleton rests on the outline of the old one only.
        """
        result = np.zeros_like(painted)
        result[self.inner.within(self.box)] = True
        if painted.any():
            result &= ~_dilated(_dilated(painted, self._depth).T, self._depth).T
        return result

    def patch(self, skeleton: Cells, squared: Cells) -> tuple[GridPatch, Mask]:
        """The remembered cells; where nothing is, what the known skeleton says.

        Also a mask (H, W) of the latter.

        skeleton (N, 2): lattice cells in the box; squared (N,): their squared clearances. All
        within a cell's clearance is free, so the map itself keeps the outline of the places whose
        cells have been forgotten. Every other cell is enough for that.
        """
        cells = self._cells.copy()
        painted = _paint(cells, (skeleton - (self.box.row, self.box.col))[::2], squared[::2])
        cells[cells == _NEVER] = UNKNOWN
        return GridPatch(self.lattice.with_origin_at(self.box.row, self.box.col), cells), painted

    def _place_of(self, frame: GridFrame) -> tuple[int, int]:
        if frame.resolution != self.lattice.resolution:
            raise InputError(
                f'window with {frame.resolution} m a cell: expected {self.lattice.resolution} m'
            )
        row = (frame.origin_y - self.lattice.origin_y) / frame.resolution
        col = (frame.origin_x - self.lattice.origin_x) / frame.resolution
        if abs(row - round(row)) > _OFF_LATTICE or abs(col - round(col)) > _OFF_LATTICE:
            origin = (frame.origin_x, frame.origin_y)
            raise InputError(
                f'window at {origin}: expected whole cells from the first window of the map'
            )
        return round(row), round(col)


def _reach(config: TopologyConfig, resolution: float) -> int:
    """How far round a window is remembered, in cells."""
    return max(
        round(config.window_memory_m / resolution), round(config.update_context_m / resolution)
    )


def _wrapped(first: int, count: int, size: int) -> list[tuple[slice, slice]]:
    """The one or two runs of `count` indices from `first` on in a ring of `size`.

    Each as slices in the run, and in the ring.
    """
    at = first % size
    head = min(count, size - at)
    runs = [(slice(0, head), slice(at, at + head))]
    return runs if head == count else [*runs, (slice(head, count), slice(0, count - head))]


@kernel
def _states(cells: States) -> States:
    """FREE, OCCUPIED or UNKNOWN for each cell (H, W) of a patch."""
    states = np.empty(cells.shape, dtype=np.int8)
    for row in range(cells.shape[0]):
        for col in range(cells.shape[1]):
            cell = cells[row, col]
            blocked = OCCUPIED if cell >= OCCUPIED_AT_LEAST else np.int8(UNKNOWN)
            states[row, col] = FREE if 0 <= cell <= FREE_AT_MOST else blocked
    return states


@kernel
def _paint(cells: States, centres: Cells, squared: Cells) -> Mask:
    """Mark as free all cells never seen that lie nearer to a centre (N, 2) than its clearance.

    Returns which.
    """
    rows, cols = cells.shape
    painted = np.zeros((rows, cols), dtype=np.bool_)
    gaps = np.zeros(((rows >> _BLOCK) + 1, (cols >> _BLOCK) + 1), dtype=np.bool_)
    for row in range(rows):
        for col in range(cols):
            gaps[row >> _BLOCK, col >> _BLOCK] |= cells[row, col] == _NEVER
    for i in range(centres.shape[0]):
        row = centres[i, 0]
        col = centres[i, 1]
        reach = int(np.sqrt(squared[i]))
        low_row = max(row - reach, 0) >> _BLOCK
        low_col = max(col - reach, 0) >> _BLOCK
        if not np.any(
            gaps[low_row : (row + reach >> _BLOCK) + 1, low_col : (col + reach >> _BLOCK) + 1]
        ):
            continue
        for r in range(max(row - reach, 0), min(row + reach + 1, rows)):
            for c in range(max(col - reach, 0), min(col + reach + 1, cols)):
                if cells[r, c] == _NEVER and (r - row) ** 2 + (c - col) ** 2 < squared[i]:
                    painted[r, c] = True
    for row in range(rows):
        for col in range(cols):
            if painted[row, col]:
                cells[row, col] = FREE
    return painted


def _dilated(mask: Mask, depth: int) -> Mask:
    """Cells with a true one within `depth` rows above or below."""
    rows = mask.shape[0]
    sums = np.zeros((rows + 2 * depth + 1, mask.shape[1]), dtype=np.int32)
    np.cumsum(mask, axis=0, out=sums[depth + 1 : depth + 1 + rows])
    sums[depth + 1 + rows :] = sums[depth + rows]
    near: Mask = sums[2 * depth + 1 :] > sums[:rows]
    return near
