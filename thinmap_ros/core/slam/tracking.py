"""Whether the robot is where the localizer takes it to be.

Scans that fit, and those that suddenly do not.
"""

from dataclasses import replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.scan_matching import Match

# From one scan to the next; a robot that is faster sees too much that is new.
_NEAR_M = 0.2
_NEAR_RAD = 0.2
_TURNED_RAD = 1.0  # up to here much of what was seen is still in view, if less surely in its place
# What is seen twice is as far away, give or take so much and so much of its range.
_SAME_M = 0.2
_SAME_SHARE = 0.05
_FEWEST_POINTS = 20
# Share of what was just seen that has to be there still; carried off, it is 0.1, seldom above 0.4.
SEEN_AGAIN = 0.45
_SEEN_AGAIN_TURNED = 0.2  # and so much of it in a turn
# Share of the points that usually fit; the second where something is wrong.
_AS_WELL = 0.5
_AS_WELL_AGAIN = 0.8
_USUAL_MEMORY = 0.9  # of what usually fits, from one scan to the next


class Tracking:
    """Lost after so many scans in a row that do not fit, or one unlike the one before it.

    Of the scan of a robot that was carried off many points fit somehow, too: so a scan has to fit
    about as well as those before it, and a robot that was carried off is found when as many in a
    row do. usual: share of a scan's points that lie on surfaces of the map, on an average; carried:
    whether the robot may be anywhere.
    """

    def __init__(self, lost_scans: int, usual: float = 0.0, carried: bool = False) -> None:
        self.usual, self._carried = usual, carried
        self._lost_scans = lost_scans
        self._misfits, self._fits = 0, 0
        self._points_before: Array | None = None

    @property
    def lost(self) -> bool:
        """Whether the robot is not where it was taken to be."""
        return self._carried or self._misfits >= self._lost_scans

    def found(self) -> None:
        """Somebody has said where the robot is."""
        self._carried, self._misfits, self._fits = False, 0, 0

    def judged(
        self, match: Match, points_base: Array, scan: Scan, increment: Array, near: bool
    ) -> Match:
        """A match that counts as good only where it is good enough.

        points_base (N, 2): of the scan; increment (3,): of the odometry since the scan before;
        near: whether the robot is where the map has just learned, so that most of the scan must be
        known.
        """
        before, self._points_before = self._points_before, points_base
        way, turn = float(np.hypot(increment[0], increment[1])), abs(float(increment[2]))
        strange = False
        if (
            before is not None
            and len(before)
            and len(points_base)
            and way <= _NEAR_M
            and turn <= _TURNED_RAD
        ):
            least = SEEN_AGAIN if turn <= _NEAR_RAD else _SEEN_AGAIN_TURNED
            strange = share_seen_again(before, increment, scan) < least
        share = match.overlap * match.fit
        if strange or self._carried:
            good = match.good and share >= _AS_WELL_AGAIN * self.usual
        else:
            known = near or 0 < self._misfits < self._lost_scans
            good = match.good and (share >= _AS_WELL * self.usual or not known)
        if good:
            self.usual = _USUAL_MEMORY * (self.usual or share) + (1.0 - _USUAL_MEMORY) * share
        elif strange:
            self._carried, self._fits = True, 0
        return replace(match, good=good)

    def count(self, good: bool, on_new_ground: bool) -> None:
        """Count a scan that fits, or does not though it lies on known ground."""
        if good:
            self._misfits, self._fits = 0, self._fits + 1
        else:
            self._misfits, self._fits = self._misfits + (not on_new_ground), 0
        self._carried &= self._fits < self._lost_scans


def share_seen_again(before: Array, increment: Array, scan: Scan) -> float:
    """Share of the points (N, 2) of one scan that the next one sees, too.

    1 where few lie in its field of view.

    before: in the robot frame of then; increment (3,): how the robot has moved since.
    """
    if scan.ranges_m.size < _FEWEST_POINTS:
        return 1.0
    T_before_laser = se2.compose(increment, scan.T_base_laser)
    points = se2.transform_points(se2.invert(T_before_laser), before)
    ranges = np.hypot(points[:, 0], points[:, 1])
    bearings = np.arctan2(points[:, 1], points[:, 0])
    turns = (bearings - scan.angle_min_rad) * np.sign(scan.angle_increment_rad)
    beams = np.round(turns % (2.0 * np.pi) / abs(scan.angle_increment_rad)).astype(np.int64)
    seen = (beams >= 1) & (beams < scan.ranges_m.size - 1)
    if int(seen.sum()) < _FEWEST_POINTS:
        return 1.0
    measured = np.where(scan.hit, scan.ranges_m, np.inf)
    beams, ranges = beams[seen], ranges[seen]
    off = np.abs(np.stack([measured[beams + k] for k in (-1, 0, 1)]) - ranges).min(axis=0)
    return float((off <= _SAME_M + _SAME_SHARE * ranges).mean())
