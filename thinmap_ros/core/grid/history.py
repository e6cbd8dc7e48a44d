"""What a grid was drawn from, to draw it anew when the robot turns out to have been elsewhere.

It grows with the area that was seen, not with time: of each place and direction the newest few
scans are kept.
"""

import math
from array import array
from collections import deque

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

_APART_M, _APART_RAD = 0.25, 0.25
_PLACE_M = 1.0  # edge of a place
_DIRECTIONS = 8  # of the robot, that are told apart there
_OF_A_PLACE = 4  # scans of each place and direction: about one visit
_Place = tuple[int, int, int]


class PoseHistory:
    """The pose of every scan.

    Those that lie 0.25 m or 0.25 rad apart are the ones that are asked for.
    Of many of these at one place the newest are asked for. A correction names some of the scans by
    their stamps and says where they were made. All others go with the last of these before them, in
    the order in which they came: stamps of real robots step back now and then.
    """

    def __init__(self) -> None:
        self._stamps = array('q')
        self._poses = array('d')
        self._last_apart = -1
        self._asked_for: dict[int, Scan | None] = {}  # by the number of scans that came before
        self._at_place: dict[_Place, deque[int]] = {}

    def add(self, stamp_ns: int, T_map_base: Array, scan: Scan | None = None) -> None:
        """Take in the pose (3,) of a scan, and the scan itself, if it is wanted again."""
        number = len(self._stamps)
        self._stamps.append(stamp_ns)
        self._poses.extend(T_map_base.tolist())
        if self._last_apart >= 0:
            moved = se2.between(self._pose(self._last_apart), T_map_base)
            if math.hypot(moved[0], moved[1]) < _APART_M and abs(float(moved[2])) < _APART_RAD:
                return
        self._last_apart = number
        self._ask_for(number, scan)

    def scans(self) -> list[Scan | None]:
        """The scans that are asked for, as they came."""
        return list(self._asked_for.values())

    def poses(self) -> Array:
        """Poses (N, 3) of the scans that are asked for, as they are known now."""
        return self._all_poses()[np.array(list(self._asked_for), dtype=np.int64)]

    def correct(self, stamps_ns: NDArray[np.int64], poses: Array, since_ns: int) -> None:
        """Move everything as the scans of these stamps (M,) move, which were made at poses (M, 3).

        since_ns: stamp of the scan from which on poses are right already, whether it has come yet
        or not.
        """
        before = self._all_poses()
        right = self._stamps.index(since_ns) if since_ns in self._stamps else len(self._stamps)
        numbers, named = self._numbers(stamps_ns, right)
        if numbers.size == 0:
            return
        anchors = np.maximum(np.searchsorted(numbers, np.arange(right), side='right') - 1, 0)
        after = _carried(before[:right], before[numbers][anchors], poses[named][anchors])
        self._poses[: 3 * right] = array('d', after.ravel().tolist())
        # Before and after, the same ones are asked for: what is too many now is dropped when more
        # come.
        self._at_place = {}
        for number in self._asked_for:
            self._here(number).append(number)

    def _ask_for(self, number: int, scan: Scan | None) -> None:
        """Put a scan at its place.

        The oldest there are asked for no more, if there are too many.
        """
        here = self._here(number)
        here.append(number)
        self._asked_for[number] = scan
        while len(here) > _OF_A_PLACE:
            del self._asked_for[here.popleft()]

    def _here(self, number: int) -> deque[int]:
        """What is asked for at the place, and in the direction, of a scan."""
        x, y, heading = self._pose(number).tolist()
        turn = math.floor(heading % (2.0 * math.pi) / (2.0 * math.pi) * _DIRECTIONS)
        place = (math.floor(x / _PLACE_M), math.floor(y / _PLACE_M), turn)
        return self._at_place.setdefault(place, deque())

    def _pose(self, number: int) -> Array:
        return np.array(self._poses[3 * number : 3 * number + 3])

    def _all_poses(self) -> Array:
        return np.array(self._poses).reshape(-1, 3)

    def _numbers(
        self, stamps_ns: NDArray[np.int64], end: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Numbers before `end` of the scans with these stamps, and which of the stamps each has.

        Stamps of no scan are left out.
        """
        number_of = {stamp: number for number, stamp in enumerate(self._stamps[:end])}
        found = sorted(
            (number_of[stamp], k)
            for k, stamp in enumerate(stamps_ns.tolist())
            if stamp in number_of
        )
        pairs = np.array(found, dtype=np.int64).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]


def _carried(poses: Array, before: Array, after: Array) -> Array:
    """Poses (N, 3) after each went along with another, from `before` (N, 3) to `after` (N, 3)."""
    turn = after[:, 2] - before[:, 2]
    c, s = np.cos(turn), np.sin(turn)
    dx, dy = (poses - before)[:, 0], (poses - before)[:, 1]
    x, y = after[:, 0] + c * dx - s * dy, after[:, 1] + s * dx + c * dy
    return np.column_stack([x, y, se2.wrap(poses[:, 2] + turn)])


class GridHistory:
    """The scans that a grid can be drawn from anew.

    They take 10 kB a metre of what is new, at most 30 kB a square metre.
    """

    def __init__(self) -> None:
        self.past = PoseHistory()

    def add(self, scan: Scan, T_map_base: Array) -> None:
        """Take in a scan that was drawn at a pose (3,)."""
        self.past.add(scan.stamp_ns, T_map_base, scan)

    def draw(self, like: OccupancyGrid) -> OccupancyGrid:
        """The grid of the kept scans at their poses, with cells and configuration of another."""
        grid = OccupancyGrid(like.config, like.frame)
        for scan, T in zip(self.past.scans(), self.past.poses(), strict=True):
            if scan is not None:
                grid.update(scan, T)
        return grid
