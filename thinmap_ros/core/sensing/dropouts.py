"""Decides from the data whether a beam without return shows free space.

A laser whose range ends in a hall has no return because nothing is in range. Cheap lasers also drop
returns of surfaces in range. The second kind contradicts itself: its beams without return cross
surfaces that it has just measured.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.scan import NO_RETURN_CLEAR_RANGE_M, Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import kernel

_REACH = 0.8  # of the range: farther walls at a small angle may have gone out of range
_APART_M = 0.1
_APART_RAD = 0.1
# Odometry drifts little over 4 m of path. Its turns are wrong by some percent: after half a radian,
# by a beam.
_VIEWS = 40
_MAX_TURN_RAD = 0.5
_SAME_SURFACE_M = 0.1
_MIN_STEP_RAD = 1e-6
# Measured over whole recordings: at most 0.017 with lasers of 3 to 80 m in rooms, halls and
# outdoors; 0.05 with one that drops 5 % of its returns, 0.27 and 0.53 with cheap ones.
_MAX_MISSED = 0.03
# Measured: at most 0.06 in halls and outdoors, 0.15 and more with lasers that drop returns.
_MAX_WRONG = 0.1


class DropoutDetector:
    """Decides for a laser whether its beams without return show free space.

    Views are scans 0.1 m or 0.1 rad apart. In each, the beams are counted that point at a surface
    of earlier views within the range that a beam without return clears, and those of them that have
    no return. No return does not mean free if the laser misses more than 3 % of what it must hit,
    and if that explains a tenth of its beams without return: in a hall most of them are right. A
    laser is trusted at first, with the weight of one scan.
    """

    def __init__(self) -> None:
        self.drops_out = False
        self._views: deque[Array] = deque(maxlen=_VIEWS)
        self._turns_rad: deque[float] = deque(maxlen=_VIEWS)  # before each view
        self._last: Array | None = None
        self._aimed = 0  # beams at surfaces
        self._missed = 0  # of these, without return
        self._unreturned = 0  # beams without return, whatever they point at

    @property
    def miss_ratio(self) -> float:
        """Share of the beams to a known surface that have no return, so far."""
        return self._missed / max(self._aimed, 1)

    @property
    def warning(self) -> str:
        """Description of a laser that drops out; '' for any other."""
        if not self.drops_out:
            return ''
        return (
            f'{100.0 * self.miss_ratio:.0f} % of the beams to surfaces that the laser has measured '
            'have no return: no return is taken as unknown, not as free'
        )

    def update(self, scan: Scan, T_odom_base: Array) -> bool:
        """Add a scan made at an odometry pose (3,); returns whether the laser drops returns."""
        if scan.is_blind or not self._is_apart(T_odom_base):
            return self.drops_out
        self._forget_turned(T_odom_base)
        self._last = T_odom_base
        aimed = self._aimed_beams(scan, T_odom_base)
        missed = int(np.count_nonzero(aimed & scan.without_return))
        self._aimed += int(np.count_nonzero(aimed & scan.hit)) + missed
        self._missed += missed
        self._unreturned += int(np.count_nonzero(scan.without_return))
        self._views.append(se2.transform_points(T_odom_base, _surfaces(scan)))
        # With a gap, so that the verdict on a laser near the limit does not alternate.
        scale = 0.5 if self.drops_out else 1.0
        most = scale * max(
            _MAX_MISSED * (self._aimed + scan.ranges_m.size), _MAX_WRONG * self._unreturned
        )
        self.drops_out = self._missed > most
        return self.drops_out

    def _forget_turned(self, T_odom_base: Array) -> None:
        """Forget the views from which the robot has turned too far since."""
        turn_rad = 0.0 if self._last is None else abs(se2.wrap(T_odom_base[2] - self._last[2]))
        self._turns_rad.append(float(turn_rad))
        while self._views and sum(self._turns_rad) > _MAX_TURN_RAD:
            self._views.popleft()
            self._turns_rad.popleft()

    def _is_apart(self, T_odom_base: Array) -> bool:
        if self._last is None:
            return True
        moved = se2.between(self._last, T_odom_base)
        return math.hypot(moved[0], moved[1]) > _APART_M or abs(float(moved[2])) > _APART_RAD

    def _aimed_beams(self, scan: Scan, T_odom_base: Array) -> NDArray[np.bool_]:
        """Which beams (N,) point at a surface of an earlier view."""
        if not self._views:
            return np.zeros(scan.ranges_m.size, dtype=np.bool_)
        T_odom_laser = se2.compose(T_odom_base, scan.T_base_laser)
        reach_m = _REACH * min(scan.range_max_m, scan.max_range_m, NO_RETURN_CLEAR_RANGE_M)
        fan = (scan.angle_min_rad, scan.angle_increment_rad, reach_m)
        points = np.vstack(self._views)
        return _interior(_aimed(points, T_odom_laser, scan.ranges_m.size, fan))


def _surfaces(scan: Scan) -> Array:
    """Hits (N, 2), robot frame, with a neighbour at the same range: not the mixed pixels."""
    ranges = np.where(scan.hit, scan.ranges_m, np.inf)
    with np.errstate(invalid='ignore'):
        near = np.abs(np.diff(ranges)) < _SAME_SURFACE_M
    surfaces = (np.append(near, False) | np.append(False, near))[scan.hit]
    return np.asarray(scan.points_base()[surfaces])


def _interior(aimed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The beams (N,) whose neighbours point at a surface, too.

    At its edge a small error of the odometry decides whether a beam meets it.
    """
    inside = np.zeros_like(aimed)
    inside[1:-1] = aimed[:-2] & aimed[1:-1] & aimed[2:]
    return inside


@kernel
def _aimed(
    points: Array, laser: Array, count: int, fan: tuple[float, float, float]
) -> NDArray[np.bool_]:
    """Which beams (count,) point at one of some points (M, 2) in reach.

    laser (3,): its pose in the frame of the points; fan: bearing of the first beam, angle between
    beams, rad, and reach, m.
    """
    first, step, reach = fan
    aimed = np.zeros(count, dtype=np.bool_)
    for k in range(points.shape[0]):
        dx = points[k, 0] - laser[0]
        dy = points[k, 1] - laser[1]
        if dx * dx + dy * dy >= reach * reach:
            continue
        ahead = (math.atan2(dy, dx) - laser[2] - first) * (1.0 if step > 0.0 else -1.0)
        ahead -= 2.0 * math.pi * math.floor(ahead / (2.0 * math.pi))
        beam = round(ahead / max(abs(step), _MIN_STEP_RAD))
        if beam < count:
            aimed[beam] = True
    return aimed
