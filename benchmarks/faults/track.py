"""True and estimated poses of the robot over time."""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import SECOND_NS, Array

_SPAN_NS = 60 * SECOND_NS
_SPEED_NS = SECOND_NS // 2


@dataclass(frozen=True)
class Located:
    """A scan that has a pose: time, s; error of the pose, m; whether the state is TRACKING.

    stamp_ns: its stamp, which may be wrong.
    """

    time_s: float
    error_m: float
    is_tracking: bool
    stamp_ns: int


class _Recent(dict[int, Array]):
    """Poses (3,) by stamp, of the last minute."""

    def put(self, stamp_ns: int, pose: Array) -> None:
        self.pop(stamp_ns, None)
        self[stamp_ns] = pose
        while stamp_ns - next(iter(self)) > _SPAN_NS:
            del self[next(iter(self))]


class Track:
    """Compares estimated with true poses, and measures the distance travelled.

    The stamps of scans may be wrong: `add_scan` tells the true time of each.
    T_world_map (3,): where the map lies in the world.
    """

    def __init__(self) -> None:
        self.T_world_map: Array = np.zeros(3)
        self.travelled_m = 0.0
        self.time_ns = 0
        self._truth = _Recent()
        self._true_ns: dict[int, int] = {}
        self._poses: dict[int, Array] = {}
        self._states: dict[int, bool] = {}
        self._waiting: deque[int] = deque(maxlen=1000)

    @property
    def time_s(self) -> float:
        """Simulated time, s."""
        return self.time_ns / SECOND_NS

    @property
    def place(self) -> Array | None:
        """True pose (3,) now; None before the first."""
        return next(reversed(self._truth.values()), None)

    def speed_m_s(self) -> float:
        """Mean speed over the last half second, m/s."""
        before_ns = self.time_ns - _SPEED_NS
        if before_ns not in self._truth:
            return 0.0
        moved = self._truth[self.time_ns][:2] - self._truth[before_ns][:2]
        return float(np.hypot(*moved)) * SECOND_NS / _SPEED_NS

    def add_truth(self, stamp_ns: int, T_world_base: Array) -> None:
        """Add a true pose (3,)."""
        if self.place is not None:
            self.travelled_m += math.dist(self.place[:2], T_world_base[:2])
        self.time_ns = stamp_ns
        self._truth.put(stamp_ns, T_world_base)

    def teleported(self) -> None:
        """The way to the next true pose is not driven."""
        self._truth.clear()

    def add_scan(self, stamp_ns: int, true_ns: int) -> None:
        """Add a scan that was passed on with a stamp, and its true time."""
        self._true_ns.pop(stamp_ns, None)
        self._true_ns[stamp_ns] = true_ns
        while len(self._true_ns) > 1000:
            del self._true_ns[next(iter(self._true_ns))]

    def add_pose(self, stamp_ns: int, T_map_base: Array) -> None:
        """Add the pose (3,) that was found for a scan."""
        self._poses[stamp_ns] = T_map_base
        self._waiting.append(stamp_ns)

    def add_state(self, stamp_ns: int, is_tracking: bool) -> None:
        """Add the state of the localizer at a scan."""
        self._states[stamp_ns] = is_tracking

    def located(self) -> list[Located]:
        """Scans whose pose, state and true pose are complete since the last call."""
        found = []
        for _ in range(len(self._waiting)):
            stamp_ns = self._waiting.popleft()
            true_ns = self._true_ns.get(stamp_ns)
            known = true_ns in self._truth and stamp_ns in self._states
            if true_ns is None or not known:
                if true_ns is None or true_ns > self.time_ns - _SPAN_NS // 10:
                    self._waiting.append(stamp_ns)
                continue
            pose = self._poses.pop(stamp_ns, None)
            if pose is None:
                continue
            believed = se2.compose(self.T_world_map, pose)
            error_m = math.dist(believed[:2], self._truth[true_ns][:2])
            is_tracking = self._states.pop(stamp_ns)
            found.append(Located(true_ns / SECOND_NS, error_m, is_tracking, stamp_ns))
        return found

    def align(self, T_map_base: Array, stamp_ns: int) -> None:
        """Let the map lie where a pose (3,) at a stamp is the true one."""
        truth = self._truth.get(self._true_ns.get(stamp_ns, -1))
        if truth is not None:
            self.T_world_map = se2.compose(truth, se2.invert(T_map_base))
