"""Goals of Nav2's actions as poses in the map frame."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav2_msgs.action import NavigateThroughPoses, NavigateToPose

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.nodes.navigation.map_input import MapInput
from thinmap_ros.ros import messages, parameters
from thinmap_ros.ros.action_server import InvalidGoalError
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.tf import TransformListener

_MAX_POSES = 10_000
_LOOKUP_STEP_NS = 20_000_000


class ErrorCode(IntEnum):
    """Codes of the results, as in Nav2 from Kilted on: Jazzy's messages do not name them."""

    NONE = 0
    UNKNOWN = 9000
    TF_ERROR = 9002
    TIMEOUT = 9003


@dataclass(frozen=True)
class NavigationTask:
    """Poses (3,) in the map frame: all but the last one are passed on the way.

    action: the one that the goal came by, with the types of its feedback and result; start_ns: time
    at which the goal was accepted, by the node's `elapsed_time`.
    """

    action: Any
    poses: tuple[Array, ...]
    start_ns: int

    def result(self, code: ErrorCode, text: str) -> Any:
        """Result of the action."""
        return self.action.Result(error_code=int(code), error_msg=text)


class _TransformError(InputError):
    """The frame of a goal is unknown, or was not known at the time of its stamp."""


class TaskReader:
    """Reads goals in any frame that is connected to the map by transforms.

    stop_reason: why it refuses all of them, '' if it does not.
    """

    def __init__(self, node: ThinmapNode, map_frame: str, map_input: MapInput) -> None:
        """Declare the parameter `transform_tolerance`; map_input: has the keep-out areas."""
        self.stop_reason = ''
        self._node = node
        self._map_frame = map_frame
        self._map = map_input
        self._transforms = TransformListener(node)
        tolerance_s = parameters.declare_parameter(
            node,
            'transform_tolerance',
            0.3,
            'Age up to which a transform is used for a goal in another frame than the map, before '
            'the stamp of the goal (s). Raise it if goals are aborted because transforms are late, '
            'lower it if the robot moves far in this time.',
            low=0.0,
        )
        self._tolerance_ns = round(float(tolerance_s) * SECOND_NS)

    def reset(self) -> None:
        """Forget the transforms that are not static: the time was set back."""
        self._transforms.clear()

    def to_pose(self, request: NavigateToPose.Goal) -> NavigationTask:
        """Task of a goal of navigate_to_pose. Raises InvalidGoalError."""
        return self._read(NavigateToPose, request, lambda: (self.pose(request.pose),))

    def through_poses(self, request: NavigateThroughPoses.Goal) -> NavigationTask:
        """Task of a goal of navigate_through_poses. Raises InvalidGoalError."""

        def poses() -> tuple[Array, ...]:
            if not 0 < len(request.poses) <= _MAX_POSES:
                raise InputError(f'{len(request.poses)} poses: expected 1 to {_MAX_POSES}')
            return tuple(self.pose(message) for message in request.poses)

        return self._read(NavigateThroughPoses, request, poses)

    def pose(self, message: PoseStamped) -> Array:
        """Pose (3,) of a message in the map frame.

        Raises InputError where it is invalid, or its frame unknown.
        """
        pose = messages.pose_from_msg(message.pose)
        frame = message.header.frame_id.lstrip('/')
        if frame in ('', self._map_frame):
            return pose
        return se2.compose(self._lookup(frame, messages.stamp_ns(message.header.stamp)), pose)

    def require_open(self, poses: tuple[Array, ...]) -> None:
        """Raise InputError where one of the poses (3,) is in a keep-out area."""
        self._map.keep_out.require_open(np.array([pose[:2] for pose in poses]))

    def _lookup(self, frame: str, stamp_ns: int) -> Array:
        """T_map_frame (3,) at a stamp, or shortly before it; the newest for stamp 0, as in tf2."""
        reason = ''
        tolerance_ns = self._tolerance_ns if stamp_ns else 0
        for age_ns in range(0, tolerance_ns + 1, _LOOKUP_STEP_NS):
            at_ns = max(stamp_ns - age_ns, 0)
            try:
                return self._transforms.lookup(self._map_frame, frame, at_ns or None)
            except InputError as error:
                reason = reason or str(error)
        raise _TransformError(
            f'frame {quoted(frame)}: {reason}: expected a frame connected to "{self._map_frame}"'
        )

    def _read(
        self, action: Any, request: Any, poses: Callable[[], tuple[Array, ...]]
    ) -> NavigationTask:
        logger = self._node.get_logger()
        if request.behavior_tree:
            logger.warning(f'behavior_tree {quoted(request.behavior_tree)} ignored: there is none')
        start_ns = self._node.elapsed_time.now_ns()
        try:
            if self.stop_reason:
                raise InputError(self.stop_reason)
            task = NavigationTask(action, poses(), start_ns)
            self.require_open(task.poses)
            return task
        except InputError as error:
            is_frame = isinstance(error, _TransformError)
            code = ErrorCode.TF_ERROR if is_frame else ErrorCode.UNKNOWN
            text = f'goal: {error}'
            logger.warning(text)
            result = NavigationTask(action, (), start_ns).result(code, text)
            raise InvalidGoalError(result) from error
