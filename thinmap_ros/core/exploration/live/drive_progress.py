"""Whether a drive makes progress."""

import math
from dataclasses import dataclass, field

from thinmap_ros.core.se2 import Array, wrap

_STEP_M = 0.1
_DETOUR_M = 1.0
_MAX_DETOURS = 3
# Longer gaps between two updates are missing inputs, no standstill.
_MAX_GAP_S = 10.0
_SAME_M = 0.1
_SAME_RAD = 0.2


def is_same_goal(a: Array, b: Array) -> bool:
    """Whether two goals (3,) are so near to each other that they are one."""
    near = math.dist(a[:2], b[:2]) <= _SAME_M
    return near and abs(wrap(float(a[2] - b[2]))) <= _SAME_RAD


@dataclass
class _Approach:
    """Smallest distance to a goal so far, m."""

    nearest_m: float = math.inf

    def is_closer(self, distance_m: float) -> bool:
        """Whether a distance is clearly smaller than all before."""
        if distance_m > self.nearest_m - _STEP_M:
            return False
        self.nearest_m = distance_m
        return True


@dataclass
class DriveProgress:
    """Time without progress of a drive to a goal (3,).

    Progress is a smaller distance to the goal than ever, straight or along the remaining path. A
    new path that is longer by a metre is a detour, and its progress is measured anew, up to three
    times.
    """

    goal: Array
    idle_s: float = 0.0
    _straight: _Approach = field(default_factory=_Approach)
    _path: _Approach = field(default_factory=_Approach)
    _detours: int = 0
    _last_s: float = math.nan

    def update(self, T_map_base: Array, remaining_m: float | None, now_s: float) -> None:
        """Process the present pose (3,) and the remaining path, m; None where it is unknown."""
        gap_s = 0.0 if math.isnan(self._last_s) else now_s - self._last_s
        self._last_s = now_s
        self.idle_s += min(max(gap_s, 0.0), _MAX_GAP_S)
        is_closer = self._straight.is_closer(math.dist(T_map_base[:2], self.goal[:2]))
        if remaining_m is not None:
            self._check_detour(remaining_m)
            is_closer |= self._path.is_closer(remaining_m)
        if is_closer:
            self.idle_s = 0.0

    def _check_detour(self, remaining_m: float) -> None:
        if remaining_m > self._path.nearest_m + _DETOUR_M and self._detours < _MAX_DETOURS:
            self._detours += 1
            self._path = _Approach()
