"""Decides from the data whether a beam without return shows free space.

A laser whose range ends in a hall has no return because nothing is in range. Cheap lasers also drop
returns of surfaces in range. The second kind contradicts itself: its beams without return cross
surfaces that it has just measured.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.jit import kernel
from thinmap_ros.core.scan import NO_RETURN_CLEAR_RANGE_M, Scan
from thinmap_ros.core.se2 import Array

_REACH = 0.9  # of the range: a farther surface may have gone out of range
_APART_M = 0.1
_APART_RAD = 0.1
_VIEWS = 40  # about 4 m of path: odometry does not drift by more than a wall's thickness
_SAME_SURFACE_M = 0.1
_MIN_STEP_RAD = 1e-6
# Measured: 0.02 to 0.14 in halls and outdoors, 0.41 to 0.90 with lasers that drop returns.
_MAX_CONTRADICTED = 0.25


@dataclass(frozen=True)
class _Evidence:
    """Number of beams without return, and of those that cross a surface measured before."""

    unreturned: float
    contradicted: float

    @property
    def ratio(self) -> float:
        """Share of the beams without return that show no free space."""
        return self.contradicted / self.unreturned

    def plus(self, unreturned: int, contradicted: int) -> '_Evidence':
        """The evidence with a view more."""
        return _Evidence(self.unreturned + unreturned, self.contradicted + contradicted)


class DropoutDetector:
    """Decides for a laser whether its beams without return show free space.

    Views are scans 0.1 m or 0.1 rad apart. In each, the beams without return are counted, and those
    that cross a surface of earlier views within the range that such a beam clears. If more than a
    quarter of them do, they are no evidence of free space. A laser is trusted at first, with the
    weight of one scan.
    """

    def __init__(self) -> None:
        self.drops_out = False
        self._views: deque[Array] = deque(maxlen=_VIEWS)
        self._last: Array | None = None
        self._evidence: _Evidence | None = None

    @property
    def contradicted_ratio(self) -> float:
        """Share of the beams without return that cross a surface, so far."""
        return 0.0 if self._evidence is None else self._evidence.ratio

    @property
    def warning(self) -> str:
        """Description of a laser that drops out; '' for any other."""
        if not self.drops_out:
            return ''
        return (
            f'{100.0 * self.contradicted_ratio:.0f} % of the beams without return cross surfaces '
            'that the laser has measured: they are taken as unknown, not as free'
        )

    def update(self, scan: Scan, T_odom_base: Array) -> bool:
        """Add a scan made at an odometry pose (3,); returns whether the laser drops returns."""
        if scan.is_blind or not self._is_apart(T_odom_base):
            return self.drops_out
        self._last = T_odom_base
        evidence = self._evidence or _Evidence(float(scan.ranges_m.size), 0.0)
        unreturned = int(np.count_nonzero(scan.without_return))
        contradicted = self._count_contradicted(scan, T_odom_base) if unreturned else 0
        self._evidence = evidence.plus(unreturned, contradicted)
        self._views.append(se2.transform_points(T_odom_base, _surfaces(scan)))
        # With a gap, so that the verdict on a laser near the limit does not alternate.
        limit = 0.5 * _MAX_CONTRADICTED if self.drops_out else _MAX_CONTRADICTED
        self.drops_out = self._evidence.ratio > limit
        return self.drops_out

    def _is_apart(self, T_odom_base: Array) -> bool:
        if self._last is None:
            return True
        moved = se2.between(self._last, T_odom_base)
        return math.hypot(moved[0], moved[1]) > _APART_M or abs(float(moved[2])) > _APART_RAD

    def _count_contradicted(self, scan: Scan, T_odom_base: Array) -> int:
        """Number of beams without return that cross a surface of an earlier view."""
        if not self._views:
            return 0
        T_odom_laser = se2.compose(T_odom_base, scan.T_base_laser)
        reach_m = _REACH * min(scan.range_max_m, scan.max_range_m, NO_RETURN_CLEAR_RANGE_M)
        fan = (scan.angle_min_rad, scan.angle_increment_rad, reach_m)
        points = np.vstack(self._views)
        return int(_count_crossing(points, T_odom_laser, scan.without_return, fan))


def _surfaces(scan: Scan) -> Array:
    """Hits (N, 2), robot frame, with a neighbour at the same range: not the mixed pixels."""
    ranges = np.where(scan.hit, scan.ranges_m, np.inf)
    with np.errstate(invalid='ignore'):
        near = np.abs(np.diff(ranges)) < _SAME_SURFACE_M
    surfaces = (np.append(near, False) | np.append(False, near))[scan.hit]
    return np.asarray(scan.points_base()[surfaces])


@kernel
def _count_crossing(
    points: Array,
    laser: Array,
    without_return: NDArray[np.bool_],
    fan: tuple[float, float, float],
) -> int:
    """Number of beams without return (N,) that point at one of some points (M, 2) in reach.

    laser (3,): its pose in the frame of the points; fan: bearing of the first beam, angle between
    beams, rad, and reach, m.
    """
    first, step, reach = fan
    crossing = np.zeros(without_return.size, dtype=np.bool_)
    for k in range(points.shape[0]):
        dx = points[k, 0] - laser[0]
        dy = points[k, 1] - laser[1]
        if dx * dx + dy * dy >= reach * reach:
            continue
        ahead = (math.atan2(dy, dx) - laser[2] - first) * (1.0 if step > 0.0 else -1.0)
        ahead -= 2.0 * math.pi * math.floor(ahead / (2.0 * math.pi))
        beam = round(ahead / max(abs(step), _MIN_STEP_RAD))
        if beam < crossing.size and without_return[beam]:
            crossing[beam] = True
    return int(np.count_nonzero(crossing))
