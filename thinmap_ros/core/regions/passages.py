"""Passages between basins of the clearance: which of them are doors, and which join corridors."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Labels = NDArray[np.int32]
Clearance = NDArray[np.float64]
Mask = NDArray[np.bool_]
_JAMB_M = 0.6  # on each side of a passage, over which a straight wall is no jamb
_FACE_M = 0.15  # up to which a straight wall is rough


@dataclass(frozen=True)
class Passage:
    """A passage between the basins a and b; cell: flat index of its widest saddle."""

    cell: int
    a: int
    b: int
    width_m: float


def passages_at(
    saddles: NDArray[np.int64], basins: Labels, clearance: Clearance, min_width_m: float
) -> list[Passage]:
    """One passage for each stretch of saddles (N, 3) between the same two basins, widest first."""
    is_saddle = np.zeros(basins.shape, dtype=np.bool_)
    is_saddle.ravel()[saddles[:, 0]] = True
    around = np.ones((3, 3), dtype=np.bool_)
    stretches = ndimage.label(ndimage.binary_dilation(is_saddle, around), around)[0].ravel()
    widths_m = 2.0 * clearance.ravel()[saddles[:, 0]]
    found: dict[tuple[int, int, int], Passage] = {}
    for (cell, a, b), width_m in zip(saddles.tolist(), widths_m.tolist(), strict=True):
        if width_m >= min_width_m:
            found.setdefault((int(stretches[cell]), a, b), Passage(cell, a, b, width_m))
    return list(found.values())


def mean_widths_m(basins: Labels, clearance: Clearance) -> NDArray[np.float64]:
    """Mean width of each basin as of a strip, by number from 0 (unused) on, m.

    Across a strip the mean clearance is a quarter of the width. At a crossing it is more in a few
    cells only, so that the largest one would call corridors that meet wide.
    """
    sums = np.bincount(basins.ravel(), clearance.ravel())
    return 4.0 * sums / np.maximum(np.bincount(basins.ravel()), 1)


def gets_wider(
    passage: Passage, basins: Labels, clearance: Clearance, reach: int, ratio: float
) -> bool:
    """Whether both basins are wider than a passage, by a ratio, within so many cells of it."""
    row, col = divmod(passage.cell, basins.shape[1])
    rows = slice(max(row - reach, 0), row + reach + 1)
    cols = slice(max(col - reach, 0), col + reach + 1)
    return all(
        ratio * float(clearance[rows, cols][basins[rows, cols] == basin].max(initial=0.0))
        > 0.5 * passage.width_m
        for basin in (passage.a, passage.b)
    )


def has_flat_jamb(passage: Passage, space: Mask, resolution_m: float) -> bool:
    """Whether the wall at one end of a passage goes straight on to both sides of it.

    So it does opposite an open door's leaf or a cupboard in a corridor; a door has a wall that ends
    at both of its jambs.
    """
    at = np.array(divmod(passage.cell, space.shape[1]))
    half = 0.5 * passage.width_m / resolution_m
    reach = math.ceil(half + _JAMB_M / resolution_m) + 1
    low = (at - reach).clip(0)
    high = at + reach + 1
    walls = np.argwhere(~space[low[0] : high[0], low[1] : high[1]]) + low - at
    if not len(walls):
        return False
    away = np.hypot(*walls.T)
    across = walls[away.argmin()] / away.min()
    beside = walls @ across
    along = walls @ np.array([-across[1], across[0]])
    deepest = half + _FACE_M / resolution_m
    for side in (1.0, -1.0):
        is_face = (side * beside > 0.5 * half) & (side * beside <= deepest)
        if _covers(along[is_face], _JAMB_M / resolution_m):
            return True
    return False


def _covers(marks: NDArray[np.float64], reach: float) -> bool:
    """Whether marks leave no gap of two cells between -reach and reach."""
    inside = np.sort(marks[np.abs(marks) <= reach])
    return bool((np.diff(np.concatenate(([-reach], inside, [reach]))) <= 2.0).all())


def joined(
    basins: Labels,
    passages: list[Passage],
    is_door: list[bool],
    free: Mask,
    least_cells: int,
) -> tuple[Labels, list[Passage]]:
    """Basins joined where a passage between them is no door: regions (H, W) from 1, and doors.

    A region of fewer than least_cells free cells joins a neighbour, through its widest door.
    """
    number = np.arange(1 + int(basins.max(initial=0)))
    cells = np.bincount(basins[free], minlength=len(number))

    def join(passage: Passage) -> None:
        low = number[passage.a]
        high = number[passage.b]
        if low != high:
            cells[high] += cells[low]
            number[number == low] = high

    for passage, separates in zip(passages, is_door, strict=True):
        if not separates:
            join(passage)
    for passage in passages:
        if min(cells[number[passage.a]], cells[number[passage.b]]) < least_cells:
            join(passage)
    region = np.unique(number, return_inverse=True)[1].astype(np.int32)
    doors = [
        Passage(passage.cell, int(region[passage.a]), int(region[passage.b]), passage.width_m)
        for passage in passages
        if region[passage.a] != region[passage.b]
    ]
    return region[basins], doors
