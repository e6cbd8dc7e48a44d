"""Where the new skeleton of the window is sewn to the chains that go on outside."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.components import label
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.topology.free_space import true_cells
from thinmap_ros.core.topology.thinning import thin

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]
Grouping = Callable[[NDArray[np.int32]], list[set[int]]]
_TRIES = 40  # nearest skeleton cells that an anchor looks at


@dataclass(frozen=True, eq=False)
class Seam:
    """The surroundings of the window, all on one array of cells.

    new (H, W): skeleton of all that is free; old (H, W): the known skeleton; window (H, W): where
    the new one takes the old one's place; free (H, W): the robot can stand there; robot: its cell,
    (1, 2), or none, (0, 2).
    """

    new: Mask
    old: Mask
    window: Mask
    free: Mask
    robot: Cells


def stitch(seam: Seam, joined_outside: Grouping) -> Mask:
    """The skeleton (H, W) that results.

    New in the window, old round it, joined over the window's rim.

    An old cell cut off at the rim needs nothing where a new one is beside it: that is how it is
    where nothing has changed. From another one a straight line goes to the nearest new cell that it
    sees over free cells. Then parts that are joined neither by the skeleton nor outside, but by
    free cells, are joined by the shortest way over these. Loops round nothing but free cells, which
    all this may leave, are drawn together to one line. A new part that the robot cannot reach
    within the surroundings, and that hangs on nothing old, is left out: it is only the corner of
    another place. joined_outside: says which numbered parts hang together outside, asked only where
    it matters.
    """
    drawn = seam.new & seam.window
    kept = seam.old & ~seam.window
    result = drawn | kept
    targets = true_cells(drawn)
    for end in _loose(kept, seam.old & seam.window, drawn):
        _draw_line(result, seam.free, end, targets)
    parts, sizes = label(result)
    if len(sizes) > 2:
        free_parts, free_sizes = label(seam.free)
        if _share_free_space(parts, free_parts, len(free_sizes)):
            _bridge_parts(result, seam.free, parts, len(sizes) - 1, joined_outside(parts))
            parts, sizes = label(result)
        robot = int(free_parts[seam.robot[0, 0], seam.robot[0, 1]]) if len(seam.robot) else 0
        _keep_held(result, parts, len(sizes), kept, free_parts, robot)
        sizes = label(result)[1]
    if euler_number(result) < len(sizes) - 1 and _fill_empty_loops(result, seam.free):
        result = thin(result)
    return result


@kernel
def _share_free_space(parts: NDArray[np.int32], free_parts: NDArray[np.int32], count: int) -> bool:
    """Whether two parts of a skeleton lie in one of the `count` - 1 parts of the free space."""
    owner = np.zeros(count, dtype=np.int32)
    for row in range(parts.shape[0]):
        for col in range(parts.shape[1]):
            part = parts[row, col]
            place = free_parts[row, col]
            if part > 0 and place > 0:
                if owner[place] > 0 and owner[place] != part:
                    return True
                owner[place] = part
    return False


@kernel
def _loose(cells: Mask, removed: Mask, others: Mask) -> Cells:
    """Cells (N, 2) that had a neighbour which was removed, and have none among the others."""
    rows, cols = cells.shape
    found = np.empty((cells.size, 2), dtype=np.int64)
    count = 0
    for row in range(rows):
        for col in range(cols):
            if not cells[row, col]:
                continue
            cut = joined = False
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(col - 1, 0), min(col + 2, cols)):
                    cut |= removed[r, c]
                    joined |= others[r, c]
            if cut and not joined:
                found[count, 0] = row
                found[count, 1] = col
                count += 1
    return found[:count]


def _bridge_parts(
    result: Mask, free: Mask, parts: NDArray[np.int32], count: int, outside: list[set[int]]
) -> None:
    """Join, in place, the parts that free cells join and that do not hang together outside."""
    owner = np.arange(count + 1)
    for group in outside:
        numbers = sorted(group)
        owner[numbers] = numbers[:1]
    for number in np.unique(owner[1:])[:-1]:
        owner[owner == number] = _draw_way(result, free, owner[parts], number)


@kernel
def _keep_held(
    result: Mask,
    parts: NDArray[np.int32],
    count: int,
    kept: Mask,
    free_parts: NDArray[np.int32],
    robot: int,
) -> None:
    """Clear, in place, parts of the result without a kept cell or one in the robot's part.

    count: parts plus one. robot: the number of the part of the free space in which it is; 0: in
    none.
    """
    held = np.zeros(count, dtype=np.bool_)
    for row in range(result.shape[0]):
        for col in range(result.shape[1]):
            if result[row, col] and (
                kept[row, col] or (robot > 0 and free_parts[row, col] == robot)
            ):
                held[parts[row, col]] = True
    for row in range(result.shape[0]):
        for col in range(result.shape[1]):
            result[row, col] &= held[parts[row, col]]


def _draw_line(result: Mask, free: Mask, anchor: Cells, targets: Cells) -> None:
    """Draw a straight line of cells from an old cell to the nearest target, if it sees one near."""
    squared = ((targets - anchor) ** 2).sum(axis=1)
    for target in targets[np.argsort(squared, kind='stable')[:_TRIES]]:
        if line_is_clear(free, *anchor.tolist(), *target.tolist()):
            steps = int(np.abs(target - anchor).max())
            share = np.arange(steps + 1)[:, None] / steps
            cells = np.floor(anchor + share * (target - anchor) + 0.5).astype(np.int64)
            result[cells[:, 0], cells[:, 1]] = True
            return


@kernel
def _draw_way(result: Mask, free: Mask, owner: Cells, source: int) -> int:
    """Draw the shortest way over free cells from one owner's cells to any other's.

    Returns whom it reached.
    """
    rows, cols = free.shape
    before = np.full(free.size, -1, dtype=np.int64)
    queue = np.empty(free.size, dtype=np.int64)
    size = 0
    head = 0
    for at in range(free.size):
        if owner[at // cols, at % cols] == source and free[at // cols, at % cols]:
            before[at] = at
            queue[size] = at
            size += 1
    while head < size:
        at = queue[head]
        head += 1
        reached: int = owner[at // cols, at % cols]
        if reached != 0 and reached != source:
            while before[at] != at:
                result[at // cols, at % cols] = True
                at = before[at]
            return reached
        for r in range(max(at // cols - 1, 0), min(at // cols + 2, rows)):
            for c in range(max(at % cols - 1, 0), min(at % cols + 2, cols)):
                if free[r, c] and before[r * cols + c] < 0:
                    before[r * cols + c] = at
                    queue[size] = r * cols + c
                    size += 1
    return source


@kernel
def euler_number(cells: Mask) -> int:
    """Parts (joined over edges and corners) less holes, counted from 2 x 2 blocks.

    No search needed.

    Source: Gray, "Local properties of binary images in two dimensions", 1971.
    """
    rows, cols = cells.shape
    total = 0
    for row in range(rows + 1):
        for col in range(cols + 1):
            a = row > 0 and col > 0 and cells[row - 1, col - 1]
            b = row > 0 and col < cols and cells[row - 1, col]
            c = row < rows and col > 0 and cells[row, col - 1]
            d = row < rows and col < cols and cells[row, col]
            count = np.int64(a) + np.int64(b) + np.int64(c) + np.int64(d)
            if count == 1:
                total += 1
            elif count == 3:
                total -= 1
            elif count == 2 and a == d:
                total -= 2
    return total // 4


def _fill_empty_loops(skeleton: Mask, free: Mask) -> bool:
    """Fill, in place, what lies within loops of a skeleton where all of it is free.

    Returns whether there are any.
    """
    framed = np.zeros((skeleton.shape[0] + 2, skeleton.shape[1] + 2), dtype=np.bool_)
    framed[1:-1, 1:-1] = free & ~skeleton
    solid = np.ones_like(framed)
    solid[1:-1, 1:-1] = ~free & ~skeleton
    _drain(framed, solid)
    empty = framed[1:-1, 1:-1]
    skeleton |= empty
    return bool(empty.any())


@kernel
def _drain(left: Mask, solid: Mask) -> None:
    """Clear, in place, the true cells that are joined to a solid one over edges.

    The border is solid and not left.
    """
    cols = left.shape[1]
    flat = left.ravel()
    walls = solid.ravel()
    steps = np.array([-cols, -1, 1, cols], dtype=np.int64)
    stack = np.empty(flat.size, dtype=np.int64)
    count = 0
    for at in range(flat.size):
        if flat[at] and (walls[at - cols] or walls[at - 1] or walls[at + 1] or walls[at + cols]):
            flat[at] = False
            stack[count] = at
            count += 1
    while count > 0:
        count -= 1
        at = stack[count]
        for step in steps:
            if flat[at + step]:
                flat[at + step] = False
                stack[count] = at + step
                count += 1
