"""Trajectory relative to keyframes, so that corrections of keyframes move all poses."""

from array import array

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array


class KeyframeTrajectory:
    """Stamped poses, each relative to a keyframe, or to the map before the first keyframe.

    Needs 36 bytes per pose.
    """

    def __init__(self) -> None:
        self._stamps = array('q')
        self._anchors = array('i')
        self._from_anchor = array('d')

    def add(self, stamp_ns: int, anchor: int, T_anchor_base: Array) -> None:
        """Add a pose (3,) relative to a keyframe; anchor -1: relative to the map."""
        self._stamps.append(stamp_ns)
        self._anchors.append(anchor)
        self._from_anchor.extend(T_anchor_base.tolist())

    @property
    def last(self) -> int:
        """Keyframe of the last pose; -1 without one."""
        return self._anchors[-1] if self._anchors else -1

    @property
    def T_last(self) -> Array:  # noqa: N802
        """The last pose (3,), relative to its keyframe; 0 without one."""
        return np.array(self._from_anchor[-3:] or np.zeros(3))

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps (N,), ns."""
        return np.array(self._stamps, dtype=np.int64)

    def poses(self, keyframes: Array) -> Array:
        """Poses (N, 3), map frame, given the poses (M, 3) of the keyframes."""
        # The last row is the origin of the map: index -1 selects it.
        anchors = np.vstack([keyframes.reshape(-1, 3), np.zeros(3)])[
            np.array(self._anchors, dtype=np.int64)
        ]
        moved = np.array(self._from_anchor).reshape(-1, 3)
        c = np.cos(anchors[:, 2])
        s = np.sin(anchors[:, 2])
        x = anchors[:, 0] + c * moved[:, 0] - s * moved[:, 1]
        y = anchors[:, 1] + s * moved[:, 0] + c * moved[:, 1]
        return np.column_stack([x, y, se2.wrap(anchors[:, 2] + moved[:, 2])])
