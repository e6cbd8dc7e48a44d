"""The frames of odometry messages: those of the robot's parameters, or fixed to them."""

from collections.abc import Callable
from typing import Any

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.se2 import Array
from thinmap_ros.logs import decode
from thinmap_ros.logs.frames.laser_mount import StaticTransforms


class OdometryFrames:
    """Reads T_odom_base of messages whose frames static transforms connect to odom and base frame.

    The transform from the map to the odom frame follows from these poses: in another frame they
    would place it wrongly. An empty frame is held to be that of the parameter. The first transform
    of a frame is kept.
    """

    def __init__(
        self,
        odom_frame: str,
        base_frame: str,
        subscribe: Callable[[], None],
        note: Callable[[str], None],
        static: StaticTransforms | None = None,
    ) -> None:
        """subscribe: is called once, when static transforms are needed: for `add_static`.

        note: receives, once for each field, that it is empty. static: those that are known already.
        """
        self._odom_frame = odom_frame.lstrip('/')
        self._base_frame = base_frame.lstrip('/')
        self._subscribe = subscribe
        self._is_subscribed = False
        self._note = note
        self._noted: set[str] = set()
        self._static = StaticTransforms() if static is None else static
        self._found: dict[tuple[str, str], Array] = {}

    def add_static(self, transform: Any) -> None:
        """Add a static geometry_msgs/TransformStamped. Raises InputError where it is invalid."""
        self._static.add(transform)

    def pose(self, message: Any) -> Array:
        """T_odom_base (3,) of a nav_msgs/Odometry.

        Raises InputError where it is invalid, or its frames.
        """
        T_parent_child = decode.checked_pose(message.pose.pose)
        parent = message.header.frame_id.lstrip('/')
        child = message.child_frame_id.lstrip('/')
        if parent != self._odom_frame:
            T_odom_parent = self._fixed('frame_id', parent, 'odom_frame', self._odom_frame)
            T_parent_child = se2.compose(T_odom_parent, T_parent_child)
        if child != self._base_frame:
            T_base_child = self._fixed('child_frame_id', child, 'base_frame', self._base_frame)
            T_parent_child = se2.compose(T_parent_child, se2.invert(T_base_child))
        return T_parent_child

    def _fixed(self, field: str, frame: str, parameter: str, expected: str) -> Array:
        """Pose (3,) of a frame in the expected one."""
        if not frame:
            self._note_once(field, expected)
            return np.zeros(3)
        self._subscribe_once()
        key = (expected, frame)
        found = self._found.get(key)
        if found is None:
            found = self._static.pose(expected, frame)
        if found is None:
            raise InputError(
                f'{field} {quoted(frame)}: expected {quoted(expected)} ({parameter}), '
                'or a frame that static transforms connect to it'
            )
        self._found[key] = found
        return found

    def _subscribe_once(self) -> None:
        if not self._is_subscribed:
            self._is_subscribed = True
            self._subscribe()

    def _note_once(self, field: str, expected: str) -> None:
        if field not in self._noted:
            self._noted.add(field)
            self._note(f'{field} is empty: it is held to be {quoted(expected)}')
