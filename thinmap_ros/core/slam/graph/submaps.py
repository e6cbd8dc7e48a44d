"""Submaps around keyframes, with which the scans of later visits are matched."""

import math
from collections import OrderedDict
from collections.abc import Sequence
from contextlib import suppress

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.matching.local_map import LocalMap, LocalMapConfig

AGAIN_M = 8.0  # smallest path length between two visits of a place


class Submaps:
    """Cache of submaps around keyframes; consecutive keyframes often match the same submap."""

    def __init__(
        self, config: LocalMapConfig, around: int = 4, stride: int = 4, capacity: int = 3
    ) -> None:
        """around: keyframes to either side of the centre of a submap.

        stride: keyframes that share a submap, as building it takes longer than a match.
        """
        self._config = config
        self._around = around
        self._stride = stride
        self._capacity = capacity
        self._kept: OrderedDict[tuple[int, int], tuple[Array, LocalMap]] = OrderedDict()

    def clear(self) -> None:
        """Drop all submaps, after keyframes have moved."""
        self._kept.clear()

    def around(self, frames: Sequence[Keyframe], j: int, path_m: float) -> tuple[Array, LocalMap]:
        """Pose (3,) of a submap around keyframe j, and the map in the frame of this pose.

        path_m: length of the path now; keyframes after j that belong to the current visit are not
        part of the submap.
        """
        centre = min(j - j % self._stride + self._stride // 2, len(frames) - 1)
        key = (centre, frames[j].submap)
        if key not in self._kept:
            self._kept[key] = self._built(frames, centre, j, path_m)
            if len(self._kept) > self._capacity:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]

    def before(self, frames: Sequence[Keyframe], j: int) -> tuple[Array, LocalMap]:
        """Pose (3,) of a submap of keyframe j and of those before it, and the map in its frame."""
        return self._built(frames, j, j, -math.inf)

    def _built(
        self, frames: Sequence[Keyframe], centre: int, j: int, path_m: float
    ) -> tuple[Array, LocalMap]:
        base = frames[centre].T_map_base
        submap = LocalMap(self._config)
        for i in range(max(0, centre - self._around), min(centre + self._around + 1, len(frames))):
            frame = frames[i]
            is_earlier = i <= j or path_m - frame.path_m > AGAIN_M
            if is_earlier and frame.submap == frames[j].submap:
                T = se2.between(base, frame.T_map_base)
                with suppress(InputError):  # kilometres away: nothing to match there
                    submap.add_scan(frame.points, frame.scan.T_base_laser, T)
        return base, submap
