"""Poses told by keyframes: when these are corrected, all that was seen from them goes along."""

from array import array

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array


class KeyframeTrajectory:
    """Poses with their stamps, each seen from a keyframe, or from the map where there was none yet.

    36 bytes each.
    """

    def __init__(self) -> None:
        self._stamps = array('q')
        self._anchors = array('i')
        self._from_anchor = array('d')

    def add(self, stamp_ns: int, anchor: int, T_anchor_base: Array) -> None:
        """Add a pose (3,) as seen from a keyframe; anchor -1: from the map."""
        self._stamps.append(stamp_ns)
        self._anchors.append(anchor)
        self._from_anchor.extend(T_anchor_base.tolist())

    @property
    def last(self) -> int:
        """The keyframe of the last pose; -1 without one."""
        return self._anchors[-1] if self._anchors else -1

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps (N,)."""
        return np.array(self._stamps, dtype=np.int64)

    def poses(self, keyframes: Array) -> Array:
        """Poses (N, 3) in the map, where the keyframes are at (M, 3)."""
        # The row after the last keyframe is the map's own origin, which number -1 finds.
        anchors = np.vstack([keyframes.reshape(-1, 3), np.zeros(3)])[
            np.array(self._anchors, dtype=np.int64)
        ]
        moved = np.array(self._from_anchor).reshape(-1, 3)
        c = np.cos(anchors[:, 2])
        s = np.sin(anchors[:, 2])
        x = anchors[:, 0] + c * moved[:, 0] - s * moved[:, 1]
        y = anchors[:, 1] + s * moved[:, 0] + c * moved[:, 1]
        return np.column_stack([x, y, se2.wrap(anchors[:, 2] + moved[:, 2])])
