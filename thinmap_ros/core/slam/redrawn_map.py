"""The map of points, which is drawn anew from the keyframes where a loop was closed."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.loops import Keyframe
from thinmap_ros.core.slam.scan_matching import MatchConfig, ScanMatcher

_AT_ONCE, _A_STEP = 60, 1  # keyframes drawn anew when a loop was closed, and in each step after it
_SORTED_M = 3.0  # after so much way it is asked again which of them are the nearest


class RedrawnMap:
    """The matcher with its map of points, in which there may be what was taken over."""

    def __init__(
        self, config: MatchConfig, given: Mapping[str, NDArray[Any]] | None = None
    ) -> None:
        """Begin with the `state` of another map of points, where one is given.

        Raises InputError where it is none.
        """
        self._config, self._given = config, given
        self._due: list[int] = []  # the nearest last
        self._sorted_at: Array = np.zeros(2)
        self.matcher = self._fresh()

    def begin_anew(self, keyframes: list[Keyframe], T_map_base: Array) -> None:
        """The keyframes have moved.

        Draw what is in sight of a pose (3,) at once, and the rest step by step.
        """
        self._due = list(range(len(keyframes)))
        away = self._sort(keyframes, T_map_base[:2])
        self.matcher = self._fresh()
        self._draw(keyframes, min(int((away < self._config.match_range_m).sum()), _AT_ONCE))

    def go_on(self, keyframes: list[Keyframe], T_map_base: Array) -> None:
        """Draw a few more of the keyframes that are due, the nearest to a pose (3,) first."""
        if self._due:
            here = T_map_base[:2]
            if math.dist(here, self._sorted_at) > _SORTED_M:
                self._sort(keyframes, here)
            self._draw(keyframes, _A_STEP)

    def _sort(self, keyframes: list[Keyframe], here: Array) -> Array:
        """Put what is due in order, the nearest to a place (2,) last.

        Returns their distances (N,) from there.
        """
        away = np.hypot(
            *(np.array([keyframes[k].T_map_base[:2] for k in self._due]).reshape(-1, 2) - here).T
        )
        order = np.argsort(-away)
        self._due, self._sorted_at = np.array(self._due)[order].tolist(), here.copy()
        return np.asarray(away[order])

    def _fresh(self) -> ScanMatcher:
        matcher = ScanMatcher(self._config)
        if self._given is not None:
            matcher.map.restore(self._given)
        return matcher

    def _draw(self, keyframes: list[Keyframe], count: int) -> None:
        points = self.matcher.map
        now = points.way_m, points.since_m
        points.since_m = -math.inf  # what is old counts here as well
        for k in [self._due.pop() for _ in range(min(count, len(self._due)))]:
            frame = keyframes[k]
            points.way_m = frame.way_m
            laser = se2.transform_points(frame.T_map_base, frame.scan.T_base_laser[None, :2])[0]
            self.matcher.add(se2.transform_points(frame.T_map_base, frame.points_base), laser)
        points.way_m, points.since_m = now
