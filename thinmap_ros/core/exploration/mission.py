"""What a mission is bound by: what it may use up, what it has used up, and the area to stay in."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array

_SMALLEST_STEP_M = 0.02
_WALL = np.int8(100)


@dataclass(eq=False)
class Odometer:
    """Distance driven, from poses (3,); noise of a robot that stands still does not count."""

    start: Array | None = None
    distance_m: float = 0.0
    _last: Array | None = None

    def add(self, T_map_base: Array) -> None:
        """Take a pose."""
        if self._last is None:
            self.start = self._last = T_map_base
            return
        step = float(np.hypot(*(T_map_base[:2] - self._last[:2])))
        if step >= _SMALLEST_STEP_M:
            self.distance_m += step
            self._last = T_map_base


@dataclass(frozen=True)
class Budget:
    """Limits of an exploration; 0 is none."""

    time_s: float = 0.0
    distance_m: float = 0.0
    area_m2: float = 0.0

    def used_up(self, time_s: float, distance_m: float, area_m2: float) -> str:
        """Which limit is reached, in words; empty as long as none is."""
        if 0.0 < self.time_s <= time_s:
            return f'time limit of {self.time_s:.0f} s'
        if 0.0 < self.distance_m <= distance_m:
            return f'distance limit of {self.distance_m:.1f} m'
        if 0.0 < self.area_m2 <= area_m2:
            return f'area limit of {self.area_m2:.1f} m^2'
        return ''


def inside(points: Array, polygon: Array) -> NDArray[np.bool_]:
    """Which points (N, 2) lie in a polygon (M, 2), by the even-odd rule, (N,)."""
    result = np.zeros(len(points), dtype=np.bool_)
    x = points[:, 0]
    y = points[:, 1]
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        crosses = (ay > y) != (by > y)
        if ay != by:
            result ^= crosses & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    return result


def fenced(patch: GridPatch, polygon: Array) -> GridPatch:
    """The map as it is to somebody who must not leave a polygon (M, 2), m.

    All cells outside are walls.
    """
    centres = patch.frame.centres_of(np.argwhere(np.ones(patch.shape, dtype=np.bool_)))
    within = inside(centres, polygon).reshape(patch.shape)
    return GridPatch(patch.frame, np.where(within, patch.cells, _WALL).astype(np.int8))
