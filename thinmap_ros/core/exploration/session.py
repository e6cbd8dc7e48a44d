"""What an exploration has used up."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.se2 import Array

_SMALLEST_STEP_M = 0.02


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
