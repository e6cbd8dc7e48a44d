"""Local maps of pieces of the path, with which the scan of a later visit is matched."""

import math
from collections import OrderedDict
from collections.abc import Sequence

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.matching.local_map import LocalMap, LocalMapConfig

AGAIN_M = 8.0  # a path of this length lies between leaving a place and coming back
_AROUND = 4  # keyframes to either side that make a submap
_STRIDE = 4  # keyframes that share one: building it takes longer than the match
_KEPT = 3  # submaps: as many visits as a keyframe is matched with


class Submaps:
    """Submaps around keyframes; the last are kept, as robots follow an earlier path for a while."""

    def __init__(self, config: LocalMapConfig) -> None:
        self._config = config
        self._kept: OrderedDict[tuple[int, int], tuple[Array, LocalMap]] = OrderedDict()

    def clear(self) -> None:
        """Drop all submaps: the keyframes have moved."""
        self._kept.clear()

    def around(self, frames: Sequence[Keyframe], j: int, path_m: float) -> tuple[Array, LocalMap]:
        """Pose (3,) of a submap around keyframe j, and the map in the frame of that pose.

        Of the keyframes after j, it holds those of earlier visits than that at path_m, m.
        """
        centre = min(j - j % _STRIDE + _STRIDE // 2, len(frames) - 1)
        key = (centre, frames[j].submap)
        if key not in self._kept:
            self._kept[key] = self._built(frames, centre, j, path_m)
            if len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]

    def before(self, frames: Sequence[Keyframe], j: int) -> tuple[Array, LocalMap]:
        """Pose (3,) of a submap of keyframe j and those before it, and the map in its frame."""
        return self._built(frames, j, j, -math.inf)

    def _built(
        self, frames: Sequence[Keyframe], centre: int, j: int, path_m: float
    ) -> tuple[Array, LocalMap]:
        base = frames[centre].T_map_base
        submap = LocalMap(self._config)
        for i in range(max(0, centre - _AROUND), min(centre + _AROUND + 1, len(frames))):
            frame = frames[i]
            is_earlier = i <= j or path_m - frame.path_m > AGAIN_M
            if is_earlier and frame.submap == frames[j].submap:
                T = se2.between(base, frame.T_map_base)
                submap.add_scan(frame.points, frame.scan.T_base_laser, T)
        return base, submap
