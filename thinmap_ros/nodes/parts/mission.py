"""The mission of an explorer: settings, goals, steps, checkpoints and what it publishes."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from uuid import uuid4

import numpy as np
from action_msgs.msg import GoalStatus, GoalStatusArray
from geometry_msgs.msg import Point, Pose, PoseStamped, Vector3
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Bool, ColorRGBA, String
from unique_identifier_msgs.msg import UUID
from visualization_msgs.msg import Marker, MarkerArray

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import EndNode as EndNodeMsg
from thinmap_msgs.msg import EndNodeArray, ExplorationStatus
from thinmap_ros.core import snapshot
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError, InputError, quoted
from thinmap_ros.core.exploration.explorer import Explorer, ExplorerConfig
from thinmap_ros.core.exploration.mission import (
    Budget,
    Mission,
    MissionGoal,
    MissionState,
    is_same_goal,
)
from thinmap_ros.core.exploration.strategy import EndNode, ShowsFrontiers, Strategy
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import Field, State
from thinmap_ros.files import sessions
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.action_server import InvalidGoalError
from thinmap_ros.ros.laser_transform import LaserTransform
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.services import action_servers
from thinmap_ros.strategies import DEFAULT, NAMES, check_strategy, make_strategy

_ACTIVE = (
    GoalStatus.STATUS_ACCEPTED,
    GoalStatus.STATUS_EXECUTING,
    GoalStatus.STATUS_CANCELING,
)
_THROUGH_POSES = 'navigate_through_poses'
PREFIX_BYTES = 8


class _GoalStatuses:
    """Goals of one action that are not at their end, by its last status message."""

    def __init__(self, node: Node, action: str) -> None:
        self._node = node
        self._action = action
        self._active: set[bytes] = set()
        self._servers: set[bytes] = set()
        topic = f'{action}/_action/status'
        node.create_subscription(GoalStatusArray, topic, self._on_status, qos.LATCHED)

    def active(self) -> set[bytes]:
        """Ids of the goals; none once the servers that reported them are gone."""
        if (
            self._active
            and self._servers
            and not self._servers & action_servers(self._node, self._action)
        ):
            self._active.clear()
        return self._active

    def _on_status(self, message: GoalStatusArray) -> None:
        self._servers = action_servers(self._node, self._action)
        self._active = {
            bytes(status.goal_info.goal_id.uuid)
            for status in message.status_list
            if status.status in _ACTIVE
        }


class GoalMonitor:
    """Whether the server of an action drives for somebody else.

    It looks at navigate_through_poses in the same namespace, too, as one robot serves both.
    prefix: PREFIX_BYTES with which the ids of our own goals begin; that of a client that was killed
    makes its goals our own.
    """

    def __init__(self, node: Node, action: str) -> None:
        """action: name of the action navigate_to_pose."""
        self.prefix = uuid4().bytes[:PREFIX_BYTES]
        sibling = action[: action.rfind('/') + 1] + _THROUGH_POSES
        self._actions = [_GoalStatuses(node, name) for name in dict.fromkeys((action, sibling))]

    def new_id(self) -> UUID:
        """Id for a goal of our own."""
        return UUID(uuid=list(self.prefix + uuid4().bytes[PREFIX_BYTES:]))

    def is_taken(self) -> bool:
        """Whether somebody else has a goal there that is not at its end."""
        return any(
            not goal_id.startswith(self.prefix)
            for action in self._actions
            for goal_id in action.active()
        )


_ARRIVED_M = 0.3
# Receives whether the robot reached the last goal, and the reason where it did not.
OnResult = Callable[[bool, str], None]


class Driver:
    """Drives to one goal at a time, and reports how the last one ended.

    goal: the one (3,) that has not ended.
    """

    def __init__(self, on_result: OnResult) -> None:
        self._on_result = on_result
        self.goal: Array | None = None

    @property
    def is_driving(self) -> bool:
        """Whether there is a goal that has not ended."""
        return self.goal is not None

    @property
    def is_yielding(self) -> bool:
        """Whether the goal waits for the end of somebody else's."""
        return False

    @property
    def goal_prefix(self) -> bytes:
        """PREFIX_BYTES with which the ids of its goals begin."""
        return bytes(PREFIX_BYTES)

    def adopt(self, goal_prefix: bytes) -> None:
        """Count the goals of a killed driver as own ones, by their prefix."""

    def drive_to(self, goal: Array) -> None:
        """Set the goal (3,) in the map frame, instead of an earlier one."""
        self.goal = goal

    def cancel(self) -> None:
        """Cancel the goal; there is no result."""
        self.goal = None

    def robot_moved(self, T_map_base: Array) -> None:
        """Process the present pose (3,) of the robot."""


class ForeignDriver(Driver):
    """Another navigator drives to the published targets until it arrives, or the target changes."""

    def robot_moved(self, T_map_base: Array) -> None:
        """Report the arrival of a robot at a pose (3,)."""
        goal = self.goal
        if goal is not None and np.hypot(*(goal[:2] - T_map_base[:2])) <= _ARRIVED_M:
            self.goal = None
            self._on_result(True, '')


_ID_BYTES = 16
_STRATEGY = 'strategy_'
_IDS = {
    'goal_ids': Field(np.uint8, ('g', _ID_BYTES)),  # none, or one
    'drive_prefix': Field(np.uint8, (PREFIX_BYTES,)),
}


@dataclass(frozen=True, eq=False)
class ExplorerState:
    """What an explorer that was killed and is started again continues with.

    latest_ns: stamp of the last observation; 0 before the first. goal_id: of the action explore;
    empty without one. drive_prefix: of the goals at the navigator, as in `GoalMonitor`. mission: as
    `mission_state`; strategy: as `StrategySource.state`.
    """

    latest_ns: int
    goal_id: bytes
    drive_prefix: bytes
    mission: State
    strategy: State

    def arrays(self) -> State:
        """The state as arrays by name."""
        return {
            'latest_ns': np.array(self.latest_ns),
            'goal_ids': np.frombuffer(self.goal_id, dtype=np.uint8).reshape(-1, _ID_BYTES),
            'drive_prefix': np.frombuffer(self.drive_prefix, dtype=np.uint8),
            **self.mission,
            **{f'{_STRATEGY}{name}': array for name, array in self.strategy.items()},
        }

    @staticmethod
    def from_arrays(state: State) -> 'ExplorerState':
        """State of its `arrays`; those of mission and strategy are not checked.

        Raises InputError where the others are invalid.
        """
        latest_ns, rest = snapshot.split_number(state, 'latest_ns')
        own, rest = snapshot.split(rest, _IDS)
        ids = snapshot.validate(own, _IDS, 'explorer')
        goal_id = ids['goal_ids'][:1].tobytes()
        strategy, mission = snapshot.split_prefix(rest, _STRATEGY)
        prefix = ids['drive_prefix'].tobytes()
        return ExplorerState(latest_ns, goal_id, prefix, mission, strategy)


ACTION = 'explore'


class Starts:
    """Starts the explorer by itself, and refuses goals while the robot is stopped.

    The goal is one of the action, so that its status is public and anybody can cancel it. is_due:
    whether it is still to be sent; is_paused: whether it waits to be continued. stop_reason: why
    the robot is stopped, '' if it is not.
    """

    def __init__(self, node: Node) -> None:
        self.is_due = False
        self.is_paused = False
        self.stop_reason = ''
        self._client = ActionClient(node, Explore, ACTION)

    def reset(self, is_due: bool) -> None:
        """Begin again; a robot that is stopped does not start by itself."""
        self.is_due = is_due and not self.stop_reason
        self.is_paused = False

    def stop_changed(self, reason: str) -> None:
        """Follow the stop of the robot: what has not started yet does not start after it."""
        self.stop_reason = reason
        self.is_due = self.is_due and not reason

    def send_if_due(self) -> None:
        """Send the goal, once, as soon as the server is found."""
        if self.is_due and not self.is_paused and self._client.server_is_ready():
            self.is_due = False
            self._client.send_goal_async(Explore.Goal())

    def read(self, message: Explore.Goal) -> MissionGoal:
        """Goal of a message. Raises InvalidGoalError where it is invalid, or the robot stopped."""
        try:
            if self.stop_reason:
                raise InputError(self.stop_reason)
            return _mission_goal(message)
        except InputError as error:
            status = ExplorationStatus(
                state=ExplorationStatus.FINISHED,
                reason_code=ExplorationStatus.CANCELLED,
                reason=str(error),
            )
            raise InvalidGoalError(Explore.Result(status=status)) from error


def _mission_goal(message: Explore.Goal) -> MissionGoal:
    """Goal of a mission. Raises InputError where a limit or a corner is no number, or too large."""
    budget = Budget(message.time_limit_s, message.distance_limit_m, message.area_limit_m2)
    area = np.array([[point.x, point.y] for point in message.area.points]).reshape(-1, 2)
    return MissionGoal(budget, area, bool(message.return_home))


# Words of explore/status, as explore_lite has them.
STARTED = 'exploration_started'
IN_PROGRESS = 'exploration_in_progress'
PAUSED = 'exploration_paused'
COMPLETE = 'exploration_complete'
RETURNING = 'returning_to_origin'
RETURNED = 'returned_to_origin'
_NAMESPACE = 'frontiers'
_POINT_M = 0.1
_SPHERE_M = 0.3
_BLUE = ColorRGBA(b=1.0, a=1.0)
_GREEN = ColorRGBA(g=1.0, a=1.0)
_RED = ColorRGBA(r=1.0, a=1.0)


def status_of(mission: Mission, is_yielding: bool) -> str:
    """Word of explore/status for a mission; empty before the first one.

    is_yielding: whether the robot drives for somebody else.
    """
    is_paused = mission.is_paused or is_yielding
    if mission.is_running and is_paused:
        return PAUSED
    if mission.state == MissionState.EXPLORING:
        return STARTED if mission.decision is None else IN_PROGRESS
    if mission.state == MissionState.RETURNING:
        return RETURNING
    if mission.state == MissionState.FINISHED:
        if mission.has_returned:
            return RETURNED
        # An exploration that was cancelled or failed continues at the next start.
        return COMPLETE if mission.end.is_explored else PAUSED
    return ''


class ExploreLiteTopics:
    """Publishes the state of a mission as explore_lite does, and hears explore/resume."""

    def __init__(self, node: ThinmapNode, frame_id: str, on_resume: Callable[[bool], None]) -> None:
        """on_resume: receives whether to continue or to pause."""
        self._node = node
        self._frame_id = frame_id
        self._status = node.create_publisher(String, 'explore/status', qos.LATCHED)
        self._frontiers = node.create_publisher(
            MarkerArray, 'explore/frontiers', QoSProfile(depth=10)
        )
        self._last_status = ''
        self._is_complete = False
        self._on_resume = on_resume
        node.diagnostics.expect_topic('explore/resume')
        node.create_subscription(Bool, 'explore/resume', self._on_message, qos.STREAM)

    def _on_message(self, message: Bool) -> None:
        self._node.diagnostics.message_received('explore/resume')
        if self._node.is_active:
            self._on_resume(bool(message.data))

    def publish_status(self, mission: Mission, is_yielding: bool) -> None:
        """Publish the status where it has changed; none is left out between two calls."""
        status = status_of(mission, is_yielding)
        if status in (RETURNING, RETURNED) and not self._is_complete:
            self._publish(COMPLETE)
        self._is_complete = status in (COMPLETE, RETURNING, RETURNED) or (
            status == PAUSED and self._is_complete
        )
        if status:
            self._publish(status)

    def publish_frontiers(self, mission: Mission) -> None:
        """Publish the frontiers of a mission, for subscribers only."""
        if self._frontiers.get_subscription_count() == 0:
            return
        markers = [Marker(action=Marker.DELETEALL)]
        markers += [self._points(cells) for cells in _cells_of(mission)]
        decision = mission.decision
        if decision is not None:
            for node in decision.end_nodes:
                if node.frontier_length_m > 0.0:
                    markers.append(self._sphere(node, node.node_id in decision.unreachable))
        header = messages.header(self._frame_id, self._node.now_ns)
        for number, marker in enumerate(markers):
            marker.header = header
            marker.ns = _NAMESPACE
            marker.id = number
        self._frontiers.publish(MarkerArray(markers=markers))

    def _publish(self, status: str) -> None:
        if status != self._last_status:
            self._last_status = status
            self._status.publish(String(data=status))

    def _points(self, cells: Array) -> Marker:
        return Marker(
            type=Marker.POINTS,
            pose=_identity(),
            scale=Vector3(x=_POINT_M, y=_POINT_M, z=_POINT_M),
            color=_BLUE,
            points=[Point(x=x, y=y) for x, y in cells.tolist()],
        )

    def _sphere(self, node: EndNode, is_unreachable: bool) -> Marker:
        size_m = _SPHERE_M * max(1.0, float(np.sqrt(node.frontier_length_m)))
        marker = Marker(type=Marker.SPHERE, pose=_identity())
        marker.pose.position = Point(x=node.x, y=node.y)
        marker.scale = Vector3(x=size_m, y=size_m, z=_SPHERE_M)
        marker.color = _RED if is_unreachable else _GREEN
        return marker


def _cells_of(mission: Mission) -> list[Array]:
    strategy = mission.strategy
    return strategy.frontiers() if isinstance(strategy, ShowsFrontiers) else []


def _identity() -> Pose:
    return messages.pose_msg(np.zeros(3))


_NOT_ESTIMATED = -1.0


def _end_node_msg(node: EndNode) -> EndNodeMsg:
    is_observed = math.isfinite(node.min_distance_m)
    return EndNodeMsg(
        node_id=node.node_id,
        position=Point(x=node.x, y=node.y),
        position_probability=node.probability,
        distance_index=node.distance_index,
        angle_index=node.angle_index,
        min_distance_m=node.min_distance_m if is_observed else 0.0,
        angle_span_deg=node.angle_span_deg,
        expected_area_m2=node.expected_area_m2,
        is_target=node.is_target,
    )


class MissionPublishers:
    """Publishes end nodes, status, and each new target on exploration_target.

    lite: publishes the state as explore_lite does.
    """

    def __init__(self, node: ThinmapNode, frame_id: str, on_resume: Callable[[bool], None]) -> None:
        """on_resume: receives what explore/resume asks for, continue or pause."""
        self._node = node
        self._frame_id = frame_id
        self._end_nodes = node.create_publisher(EndNodeArray, 'end_nodes', qos.LATCHED)
        self._status = node.create_publisher(ExplorationStatus, 'exploration_status', qos.LATCHED)
        self._targets = node.create_publisher(PoseStamped, 'exploration_target', qos.LATCHED)
        self._target: Array | None = None
        self.lite = ExploreLiteTopics(node, frame_id, on_resume)

    def target(self, goal: Array) -> None:
        """Publish where the robot drives (3,), unless it is the last target."""
        if self._target is not None and is_same_goal(self._target, goal):
            return
        self._target = goal
        self._targets.publish(messages.pose_stamped_msg(goal, self._frame_id, self._node.now_ns))

    def clear_target(self) -> None:
        """Publish the next target in any case."""
        self._target = None

    def end_nodes(self, mission: Mission, stamp_ns: int) -> None:
        """Publish the end nodes of a decision about a scan."""
        self._end_nodes.publish(self._end_nodes_msg(mission, stamp_ns))

    def end_nodes_now(self, mission: Mission) -> EndNodeArray:
        """Message of the end nodes of the last decision."""
        return self._end_nodes_msg(mission, self._node.now_ns)

    def status(self, mission: Mission) -> ExplorationStatus:
        """Publish the status; returns the message."""
        message = self.status_now(mission)
        self._status.publish(message)
        return message

    def status_now(self, mission: Mission) -> ExplorationStatus:
        """Message of the present state and progress."""
        status = ExplorationStatus(
            header=messages.header(self._frame_id, self._node.now_ns),
            state=int(mission.state),
            reason_code=int(mission.end.code),
            reason=mission.end.reason,
            distance_m=mission.odometer.distance_m,
            elapsed=messages.duration_msg(mission.elapsed_s(self._node.elapsed_time.now_s())),
            missing_area_m2=_NOT_ESTIMATED,
            missing_area_bound_m2=_NOT_ESTIMATED,
        )
        decision = mission.decision
        if decision is None:
            return status
        status.coverage_estimate = decision.coverage_estimate
        status.known_area_m2 = decision.known_area_m2
        status.reason = status.reason or decision.reason
        status.end_nodes_remaining = decision.remaining
        if decision.missing is not None:
            status.missing_area_m2 = decision.missing.expected_m2
            status.missing_area_bound_m2 = decision.missing.bound_m2
        if decision.target is not None:
            status.has_target = True
            status.target_id = decision.target.node_id
            status.target_position = Point(x=decision.target.x, y=decision.target.y)
        return status

    def _end_nodes_msg(self, mission: Mission, stamp_ns: int) -> EndNodeArray:
        end_nodes = [] if mission.decision is None else mission.decision.end_nodes
        return EndNodeArray(
            header=messages.header(self._frame_id, stamp_ns),
            end_nodes=[_end_node_msg(node) for node in end_nodes],
        )


_BASE_FRAME = 'base_link'


@dataclass(frozen=True)
class ExplorationSettings(Config):
    """Where the map comes from and who drives; names as in explore_lite where it has them."""

    drive: bool = parameter(
        True,
        'Send the targets to navigate_to_pose. false: they are only published on '
        'exploration_target, for a program or a person that drives.',
    )
    navigate_to_pose_action: str = parameter(
        'navigate_to_pose',
        'Action (nav2_msgs/NavigateToPose) that drives to the targets, of navigator or Nav2.',
    )
    autostart_exploration: bool = parameter(
        False,
        'Explore as soon as there is a map, as explore_lite does, unless the robot is stopped. '
        'false: wait for a goal of the action explore.',
    )
    return_to_init: bool = parameter(
        False,
        'Return to the start after every exploration. false: only if the goal of the action '
        'explore asks for it.',
    )
    progress_timeout: float = parameter(
        30.0,
        'Time without progress after which a target is given up (s). Raise it for a slow robot, '
        'lower it to give up blocked targets earlier. 0: never.',
        low=0.0,
        high=1e5,
    )
    costmap_topic: str = parameter(
        'map',
        'Map to explore (nav_msgs/OccupancyGrid) where no node publishes grid. In a topic whose '
        'name ends in costmap, costs below 100 are free space.',
    )
    costmap_updates_topic: str = parameter(
        '',
        'Updates of parts of that map (map_msgs/OccupancyGridUpdate), where its publisher has any. '
        'Empty: costmap_topic with _updates.',
    )
    robot_base_frame: str = parameter(
        '', 'Frame of the robot: another name of base_frame. Empty: base_frame.'
    )
    transform_tolerance: float = parameter(
        0.3,
        'Age up to which the newest transform from the robot to the map is used (s). Raise it if '
        'transforms arrive late, lower it for a fast robot.',
        low=0.0,
        high=10.0,
    )
    view_range_m: float = parameter(
        5.0,
        'Range of view that is assumed where no scans are received (m). Set it to the range of the '
        'sensor that makes the map.',
        low=0.5,
        high=100.0,
    )

    @property
    def is_costmap(self) -> bool:
        """Whether the map consists of costs."""
        return self.costmap_topic.endswith('costmap')

    def apply_base_frame(self, laser_transform: LaserTransform) -> None:
        """Set the frame of the robot by its other name.

        Raises ConfigError where both names are given, with different frames.
        """
        frame = self.robot_base_frame
        if not frame:
            return
        if laser_transform.base_frame not in (_BASE_FRAME, frame):
            raise ConfigError(
                f'robot_base_frame = {quoted(frame)}: expected the same as '
                f'base_frame = {quoted(laser_transform.base_frame)}'
            )
        laser_transform.base_frame = frame


class StrategySource:
    """Makes strategies: by the node's parameters, from a session, or of the last mission.

    A config that is changed at run time holds from the next mission on.
    """

    def __init__(self, node: Node) -> None:
        """Declare the parameters. Raises ConfigError where one is wrong."""
        self._name = str(
            parameters.declare_parameter(
                node,
                'strategy',
                DEFAULT,
                f'Exploration strategy: {", ".join(NAMES)}, or your own as package.module:factory, '
                'where factory() returns a Strategy. Parameters of end nodes and frontiers are '
                'those of position_probability and paper.',
            )
        )
        check_strategy(self._name)  # before kernels are compiled
        self._config = parameters.declare_config(node, ExplorerConfig, self._on_config)
        self._is_outdated = False

    @property
    def is_default(self) -> bool:
        """Whether the strategy is the project's own."""
        return self._name == DEFAULT

    @property
    def config(self) -> ExplorerConfig:
        """Parameters of the next new strategy."""
        return self._config

    def initial(self, session: str) -> Strategy:
        """Strategy to start with: of the session STEM where that has one, else new.

        Raises InputError where the session is broken.
        """
        self._is_outdated = False
        restored = None
        if session and self._name == DEFAULT:
            restored = sessions.EXPLORATION.load_optional(session, self._config)
        return restored or self._new()

    def next(self, last: Mission, goal: MissionGoal) -> Strategy:
        """Strategy for a goal: of the last mission where that was interrupted, else new."""
        if self._is_outdated or not last.is_resumed_by(goal):
            return self._new()
        return last.strategy

    def state(self, strategy: Strategy) -> State:
        """What a strategy has learned; empty where it cannot be saved."""
        if self._name == DEFAULT and isinstance(strategy, Explorer):
            return strategy.state()
        return {}

    def restored(self, state: State) -> Strategy:
        """Strategy that continues with a `state`, if there is one; else new.

        Raises InputError where the state is invalid.
        """
        if self._name == DEFAULT and state:
            return Explorer.from_state(state, self._config)
        return self._new()

    def has_learned(self, strategy: Strategy) -> bool:
        """Whether a strategy has something to save."""
        return sessions.EXPLORATION.has_content(self.state(strategy))

    def save(self, path: str, strategy: Strategy, overwrite: bool) -> str:
        """Save what a strategy has learned, if it can be saved; returns what was done.

        Raises as `SessionPart.save`.
        """
        if self._name == DEFAULT and isinstance(strategy, Explorer):
            return f'saved {sessions.EXPLORATION.save(path, strategy, overwrite)}'
        archived = sessions.EXPLORATION.archive(path)
        nothing = f'strategy {self._name} has nothing to save'
        return f'{nothing}; {archived}' if archived else nothing

    def _new(self) -> Strategy:
        self._is_outdated = False
        return make_strategy(self._name, self._config)

    def _on_config(self, config: ExplorerConfig) -> None:
        self._config = config
        self._is_outdated = True
