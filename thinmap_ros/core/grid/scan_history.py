"""Stored poses and scans, for re-rendering the grid after a loop closure."""

import math
from array import array
from collections import deque
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array

_MAX_PLACE = 1 << 26  # more places than lie within MAX_COORDINATE_M
Kept = TypeVar('Kept')


@dataclass(frozen=True)
class HistoryConfig:
    """Which scans are stored: those some distance or angle apart, the newest of each place."""

    apart_m: float = 0.25
    apart_rad: float = 0.25
    place_m: float = 1.0  # edge of a place
    directions: int = 8  # robot headings that are distinguished at each place
    scans_per_place: int = 4  # and direction: about one visit


class CorrectedPoses(NamedTuple):
    """Poses (N, 3) of the stored scans before and after the corrections of a map."""

    before: Array
    after: Array


class PoseHistory(Generic[Kept]):
    """The pose of every scan, and stored data of some scans.

    Of the scans that are 0.25 m or 0.25 rad apart, the newest four of each place and direction are
    stored: their number grows with the area, not with time. A correction gives the poses of some
    scans, by their stamps. Every other scan moves with the last of these before it, in the order in
    which the scans were added: stamps of real robots step back now and then.
    """

    def __init__(self, config: HistoryConfig | None = None) -> None:
        self._config = config or HistoryConfig()
        self._stamps = array('q')
        self._poses = array('d')
        self._last_apart = -1
        self._kept: dict[int, Kept] = {}  # by the index of the scan
        self._at_place: dict[int, deque[int]] = {}
        # All poses before the first correction that has not been accepted yet.
        self._before: Array | None = None

    def add_pose(self, stamp_ns: int, T_map_base: Array, kept: Kept) -> None:
        """Add the pose (3,) of a scan; `kept` is stored if the scan is far enough from others."""
        number = len(self._stamps)
        self._stamps.append(stamp_ns)
        self._poses.extend(T_map_base.tolist())
        if self._last_apart >= 0:
            last = np.array(self._poses[3 * self._last_apart : 3 * self._last_apart + 3])
            moved = se2.between(last, T_map_base)
            is_near = math.hypot(moved[0], moved[1]) < self._config.apart_m
            if is_near and abs(float(moved[2])) < self._config.apart_rad:
                return
        self._last_apart = number
        self._kept[number] = kept
        at_place = self._at_place.setdefault(
            int(_places_of(T_map_base[None], self._config)[0]), deque()
        )
        at_place.append(number)
        while len(at_place) > self._config.scans_per_place:
            del self._kept[at_place.popleft()]

    def last_pose(self) -> Array | None:
        """Pose (3,) of the newest scan; None before the first."""
        return np.array(self._poses[-3:]) if self._poses else None

    def extend(self, other: 'PoseHistory[Kept]') -> None:
        """Add the scans of another history, at their present poses."""
        first = len(self._stamps)
        self._stamps.extend(other._stamps)
        self._poses.extend(other._poses)
        self._last_apart = first + other._last_apart
        self._kept |= {first + number: kept for number, kept in other._kept.items()}
        self._sort_by_place()

    def kept(self) -> list[Kept]:
        """The stored data, in the order in which it was added."""
        return list(self._kept.values())

    def kept_poses(self) -> Array:
        """Current poses (N, 3) of the stored scans."""
        return self._all_poses()[self._kept_numbers()]

    def apply_correction(self, stamps_ns: NDArray[np.int64], poses: Array, since_ns: int) -> None:
        """Correct all poses: the scans of these stamps (M,) were made at poses (M, 3).

        since_ns: stamp of the first scan whose pose is already correct, whether it was added yet or
        not. Unknown stamps are ignored.
        """
        stamps = np.array(self._stamps, dtype=np.int64)
        right_already = np.flatnonzero(stamps == since_ns)
        count = int(right_already[0]) if right_already.size else len(stamps)
        numbers, named = _numbers_of(stamps_ns, stamps[:count])
        if numbers.size == 0:
            return
        before = self._all_poses()[:count]
        if self._before is None:
            self._before = before
        anchors = np.maximum(np.searchsorted(numbers, np.arange(count), side='right') - 1, 0)
        after = _moved_along(before, before[numbers][anchors], poses[named][anchors])
        np.frombuffer(self._poses)[: 3 * count] = after.ravel()
        self._sort_by_place()

    def _sort_by_place(self) -> None:
        """Sort the stored scans by place.

        Places that have too many scans now lose the oldest ones when more arrive.
        """
        kept = self._kept_numbers()
        self._at_place = {}
        places = _places_of(self._all_poses()[kept], self._config)
        for number, place in zip(kept.tolist(), places.tolist(), strict=True):
            self._at_place.setdefault(place, deque()).append(number)

    def accept_corrections(self) -> CorrectedPoses:
        """Poses of the stored scans before and after the corrections since the last call.

        For scans added after the first of these corrections, the pose before is the one that they
        would have without it.
        """
        after = self._all_poses()
        before = after
        if self._before is not None and len(self._before):
            corrected = len(self._before)
            last = corrected - 1
            later = _moved_along(after[corrected:], after[last][None], self._before[last][None])
            before = np.vstack([self._before, later])
        self._before = None
        kept = self._kept_numbers()
        return CorrectedPoses(before[kept], after[kept])

    def _kept_numbers(self) -> NDArray[np.int64]:
        return np.array(list(self._kept), dtype=np.int64)

    def _all_poses(self) -> Array:
        return np.array(self._poses).reshape(-1, 3)


def _places_of(poses: Array, config: HistoryConfig) -> NDArray[np.int64]:
    """Number (N,) of the place and direction of each pose (N, 3)."""
    turn = np.floor(poses[:, 2] % (2.0 * math.pi) / (2.0 * math.pi) * config.directions)
    x, y = np.floor(poses[:, :2] / config.place_m).astype(np.int64).T
    places: NDArray[np.int64] = (x * _MAX_PLACE + y) * config.directions + turn.astype(np.int64)
    return places


def _numbers_of(
    wanted: NDArray[np.int64], stamps: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the wanted stamps (M,) among all (N,), ascending, and their positions in wanted.

    Of equal stamps the last is found. Unknown stamps are left out.
    """
    order = np.argsort(stamps, kind='stable')
    at = np.searchsorted(stamps[order], wanted, side='right') - 1
    named = np.flatnonzero(at >= 0)
    numbers = order[at[named]]
    found = stamps[numbers] == wanted[named]
    ascending = np.argsort(numbers[found], kind='stable')
    return numbers[found][ascending], named[found][ascending]


def _moved_along(poses: Array, before: Array, after: Array) -> Array:
    """Poses (N, 3), each moved rigidly with another from `before` to `after`, (N, 3) or (1, 3)."""
    turn = after[:, 2] - before[:, 2]
    c = np.cos(turn)
    s = np.sin(turn)
    dx, dy = (poses - before)[:, :2].T
    x = after[:, 0] + c * dx - s * dy
    y = after[:, 1] + s * dx + c * dy
    return np.column_stack([x, y, se2.wrap(poses[:, 2] + turn)])
