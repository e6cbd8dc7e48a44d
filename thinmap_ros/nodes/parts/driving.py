"""Parts of the navigator: map and robot in, goals, the team, and the watch on the base."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav2_msgs.action import NavigateThroughPoses, NavigateToPose

from thinmap_msgs.msg import LocalGrid, ProbabilityGrid
from thinmap_ros.core import se2
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.grid.edits import KeepOut
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.core.odometry import MAX_ODOMETRY_GAP_NS, OdometryBuffer
from thinmap_ros.core.planning.navigator import (
    SENSOR_DELAY_NS,
    SENSOR_TIMEOUT_NS,
    Command,
    Navigator,
    NavigatorConfig,
)
from thinmap_ros.core.planning.path_follower import Motion
from thinmap_ros.core.planning.supervision import BaseSupervisor
from thinmap_ros.core.scan import Scan, with_newest
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.sensing.beams import LaserMonitor
from thinmap_ros.core.sensing.synchronizer import InputStream
from thinmap_ros.ros import messages, parameters, qos, velocity
from thinmap_ros.ros.action_server import InvalidGoalError
from thinmap_ros.ros.diagnostics import ERROR
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.localized_scan import map_update_from_msg
from thinmap_ros.ros.maps import UNKNOWN, subscribe_to_map
from thinmap_ros.ros.subscription import subscribe_all
from thinmap_ros.ros.team import TileReceiver, heard_robots
from thinmap_ros.ros.tf import TransformListener
from thinmap_ros.ros.time_jumps import ElapsedTime

_RELEASE = 'no goal is driven before ~/reset, or a stop that is released'


class BaseWatch:
    """Compares commands and odometry; reports at level ERROR what is wrong.

    Where others publish cmd_vel too, or nobody hears it, any motion is allowed. supervisor: judges
    the motion.
    """

    def __init__(self, node: ThinmapNode, config: NavigatorConfig) -> None:
        """Declare the parameter `base_velocity_topic`."""
        self._node = node
        self.supervisor = BaseSupervisor(config)
        topic = parameters.declare_parameter(
            node,
            'base_velocity_topic',
            '',
            'Topic of the commands that the base obeys, where a multiplexer (twist_mux) is between '
            'navigator and base: its output. The motion of the robot is compared with them. Empty: '
            'the base obeys this node.',
        )
        self._own_topic = node.resolve_topic_name(velocity.TOPIC)
        self._is_behind = bool(topic)
        if topic:
            velocity.VelocitySubscription(node, node.diagnostics, self._add_command, str(topic))
        node.diagnostics.add_check(ERROR, lambda: self.fault)

    @property
    def fault(self) -> str:
        """Why no goal may be driven; '' for no reason."""
        fault = self.supervisor.fault
        return f'{fault}: {_RELEASE}' if self.supervisor.is_fast else fault

    def add_sent(self, v: float, w: float) -> None:
        """Add a command of this node, m/s and rad/s."""
        if not self._is_behind:
            self._add_command(v, w)

    def add_odometry(self, stamp_ns: int, T_odom_base: Array) -> None:
        """Add a sample of the odometry, T_odom_base (3,)."""
        now_s = self._node.elapsed_time.now_s()
        self.supervisor.set_unheard(now_s, not (self._is_behind or self.is_obeyed))
        self.supervisor.add_odometry(now_s, stamp_ns, T_odom_base)

    @property
    def subscribers(self) -> int:
        """Number of subscriptions of cmd_vel."""
        return int(self._node.count_subscribers(self._own_topic))

    @property
    def is_obeyed(self) -> bool:
        """Whether somebody hears cmd_vel, and nobody else publishes it."""
        return self.subscribers > 0 and int(self._node.count_publishers(self._own_topic)) == 1

    def _add_command(self, v: float, w: float) -> None:
        self.supervisor.add_command(self._node.elapsed_time.now_s(), v, w)


# grid_mapper answers each scan: several of the slowest laser that a robot drives by, at 2.5 Hz.
MAPPER_TIMEOUT_NS = 2 * SECOND_NS


@dataclass(frozen=True)
class MapTimeoutConfig(Config):
    """How old the map of grid_mapper may be."""

    map_timeout_s: float = parameter(
        5.0,
        'Time without a message on local_grid after which the robot stands, until the next (s): '
        'grid_mapper has ended, or hangs. 0: it drives on with the last map. Raise it if a slow '
        'machine makes the robot stop. Maps of other nodes have no time-out.',
        low=0.0,
        high=1000.0,
    )


class MapInput:
    """The newest map: grid and local_grid of grid_mapper, or else map, of whatever SLAM.

    grid is published where it changes, local_grid for each scan: it shows that grid_mapper lives.

    pose_map_id: id of the map that the pose of the robot is in; keep_out: where it must not drive.
    """

    def __init__(self, time: ElapsedTime, timeout_s: float) -> None:
        """timeout_s: as `MapTimeoutConfig`."""
        self.keep_out = KeepOut()
        self._time = time
        self._timeout_s = timeout_s
        self.reset()

    @property
    def patch(self) -> GridPatch | None:
        """The map, or None before one is received."""
        return self._map.patch

    def subscribe(self, node: ThinmapNode) -> None:
        """Start to receive maps."""
        subscribe_all(
            node,
            (ProbabilityGrid, 'grid', self._on_grid, qos.LATCHED),
            (LocalGrid, 'local_grid', self._on_local_grid, qos.LATCHED),
        )
        subscribe_to_map(node, 'map', self._on_map)

    def reset(self) -> None:
        """Discard the map, and not the keep-out areas: they are published where they change."""
        self._map = MapReceiver()
        self._has_grid = False
        self._map_id = UNKNOWN
        self.pose_map_id = UNKNOWN
        timeouts_ns = [MAPPER_TIMEOUT_NS]
        if self._timeout_s > 0.0:
            timeouts_ns.append(round(self._timeout_s * SECOND_NS))
        self._streams = [InputStream('grid_mapper', ns, ns) for ns in timeouts_ns]

    @property
    def warning(self) -> str:
        """Why the map is older than the pose; '' where it is not."""
        return self._streams[0].fault(self._time.now_ns())

    def has_two_mappers(self) -> bool:
        """Whether local_grid comes from two sources."""
        return self._streams[0].is_mixed(self._time.now_ns())

    @property
    def fault(self) -> str:
        """Why the robot must not drive on this map; '' for no reason."""
        if UNKNOWN in (self._map_id, self.pose_map_id) or self._map_id == self.pose_map_id:
            return self._streams[-1].fault(self._time.now_ns()) if self._timeout_s > 0.0 else ''
        return 'the pose is in another map than the one on grid (was the localizer restarted?)'

    def _on_grid(self, message: ProbabilityGrid) -> None:
        self._has_grid = True
        self._map_id = message.map_id
        self._map.replace(messages.grid_from_msg(message))

    def _on_local_grid(self, message: LocalGrid) -> None:
        window = map_update_from_msg(message).changes
        stamp_ns = messages.stamp_ns(message.header.stamp)
        for stream in self._streams:
            stream.add(stamp_ns, self._time.now_ns(), self._time.age_ns(stamp_ns))
        map_id = message.grid.map_id
        if UNKNOWN not in (map_id, self._map_id) and map_id != self._map_id:
            self._map = MapReceiver()
        self._map_id = map_id
        if window is not None:
            self._map.paste(window)

    def _on_map(self, patch: GridPatch) -> None:
        if not self._has_grid:
            self._map.replace(patch)


# Without a new pose the last correction of the odometry holds for a while; without odometry, the
# robot does not know its pose meanwhile.
POSE_TIMEOUT_NS = 3 * SECOND_NS
_POSE_ONLY_TIMEOUT_NS = SECOND_NS


_LASER = 'laser'  # name of the only one
_MAX_LASERS = 8


@dataclass(eq=False)
class _Laser:
    """What is known of a laser; blind_reason: of its last scan."""

    topic: str
    monitor: LaserMonitor = field(default_factory=LaserMonitor)
    blind_reason: str = ''
    stamp_ns: int = 0


@dataclass(eq=False)
class _ScanTopic:
    """Scans of a topic that are not blind: name in faults, when they come, stamp of the last.

    offset_ns: of that stamp from the odometry, when the scan was received.
    """

    name: str
    stream: InputStream
    stamp_ns: int | None = None
    offset_ns: int = 0


class RobotState:
    """Pose and view of the robot now, and whether they are recent.

    scans: the last one of each laser that is not blind; T_odom_base (3,): the last odometry;
    pose_fault: why the localizer does not trust its pose, '' where it does.
    """

    def __init__(
        self, time: ElapsedTime, has_odometry: bool, scan_topics: Iterable[str] = (_LASER,)
    ) -> None:
        """has_odometry: False where the odometry says that the robot never moves."""
        self.scans: tuple[Scan, ...] = ()
        self.pose_fault = ''
        self._time = time
        pose_timeout_ns = POSE_TIMEOUT_NS if has_odometry else _POSE_ONLY_TIMEOUT_NS
        self._streams = {
            'odometry': InputStream('odometry', SENSOR_TIMEOUT_NS, SENSOR_DELAY_NS),
            # A late pose corrects the odometry as well as a new one: they are as late as silent.
            'localizer': InputStream('localizer', pose_timeout_ns, pose_timeout_ns),
        }
        topics = tuple(scan_topics)
        names = topics if len(topics) > 1 else (_LASER,)
        self._topics = {
            topic: _ScanTopic(name, InputStream(name, SENSOR_TIMEOUT_NS, SENSOR_DELAY_NS))
            for topic, name in zip(topics, names, strict=True)
        }
        self._lasers: dict[str, _Laser] = {}  # by frame
        self._pose_fault = ''  # why the last pose was not used
        self._odometry = OdometryBuffer(max_gap_ns=MAX_ODOMETRY_GAP_NS)
        self._T_map_odom: Array | None = None
        self.T_odom_base: Array | None = None

    def add_odometry(self, stamp_ns: int, T_odom_base: Array) -> None:
        """Add the odometry, T_odom_base (3,), at a stamp."""
        self.T_odom_base = T_odom_base
        self._record(self._streams['odometry'], stamp_ns)
        self._odometry.add(stamp_ns, T_odom_base)

    def add_pose(self, stamp_ns: int, T_map_base: Array) -> None:
        """Add the pose that the localizer found, T_map_base (3,), at the stamp of its scan."""
        T_odom_base = self._odometry.interpolate(stamp_ns)
        if T_odom_base is None:
            self._pose_fault = _offset_fault('pose', self._offset_ns(stamp_ns))
            return
        self._pose_fault = ''
        self._record(self._streams['localizer'], stamp_ns)
        self._T_map_odom = se2.compose(T_map_base, se2.invert(T_odom_base))

    def add_scan(self, scan: Scan, topic: str = _LASER) -> None:
        """Add a scan; a blind one is not kept, and is a reason to stop."""
        if scan.frame not in self._lasers and len(self._lasers) >= _MAX_LASERS:
            self._lasers.clear()
        laser = self._lasers.setdefault(scan.frame, _Laser(topic))
        # On a busy machine the last odometry is of another time than the scan.
        T_odom_base = self._odometry.interpolate(scan.odometry_ns)
        if T_odom_base is None:
            T_odom_base = self.T_odom_base
        if T_odom_base is not None:
            scan = laser.monitor.checked(scan, T_odom_base)
        laser.blind_reason = scan.blind_reason
        laser.stamp_ns = scan.odometry_ns
        if not scan.is_blind:
            self.scans = with_newest(self.scans, scan)
            of_topic = self._topics[topic]
            of_topic.stamp_ns = scan.odometry_ns
            of_topic.offset_ns = self._offset_ns(scan.odometry_ns)
            self._record(of_topic.stream, scan.odometry_ns)

    @property
    def awaited_scans(self) -> list[str]:
        """Names of the lasers without a scan yet that shows anything."""
        return [each.name for each in self._topics.values() if each.stamp_ns is None]

    @property
    def awaited(self) -> list[str]:
        """What is not received yet, and is needed to drive."""
        found = self.awaited_scans
        return found if self.pose() is not None else [*found, 'pose or odometry']

    @property
    def odometry_fault(self) -> str:
        """Why the odometry is not that of now; '' for no reason."""
        return self._streams['odometry'].fault(self._time.now_ns())

    def has_two_localizers(self) -> bool:
        """Whether poses come from two sources."""
        return self._streams['localizer'].is_mixed(self._time.now_ns())

    def pose(self) -> Array | None:
        """T_map_base (3,) now; None before a pose and odometry are received."""
        if self._T_map_odom is None or self.T_odom_base is None:
            return None
        return se2.compose(self._T_map_odom, self.T_odom_base)

    def stop_reason(self) -> str:
        """Why the robot must not drive on, the cause before its consequences; '' for no reason."""
        for laser in self._lasers.values():
            if laser.blind_reason:
                return f'{self._topics[laser.topic].name} blind ({laser.blind_reason})'
        fault = self._sensor_fault() or self._laser_fault()
        return fault or self.pose_fault or self._localizer_fault()

    def _sensor_fault(self) -> str:
        now_ns = self._time.now_ns()
        topics = self._topics.values()
        for stream in (*(each.stream for each in topics), self._streams['odometry']):
            if fault := stream.fault(now_ns):
                return fault
        return next(filter(None, map(self._stamp_fault, topics)), '')

    def _laser_fault(self) -> str:
        """Which of several lasers on one topic is silent; '' for none."""
        if len(self._lasers) > len(self._topics):
            for frame, laser in self._lasers.items():
                silent_ns = -self._offset_ns(laser.stamp_ns)
                if silent_ns > SENSOR_TIMEOUT_NS:
                    return f'laser {quoted(frame)} silent for {silent_ns / SECOND_NS:.1f} s'
        return ''

    def _stamp_fault(self, topic: _ScanTopic) -> str:
        if topic.stamp_ns is None:
            return ''
        source = 'scan' if topic.name == _LASER else topic.name
        if fault := _offset_fault(source, topic.offset_ns):
            return fault
        # Also where the clock stands.
        silent_ns = -self._offset_ns(topic.stamp_ns)
        silent = f'{topic.name} silent for {silent_ns / 1e9:.1f} s'
        return silent if silent_ns > SENSOR_TIMEOUT_NS else ''

    def _localizer_fault(self) -> str:
        fault = self._streams['localizer'].fault(self._time.now_ns())
        is_waiting = fault or self._T_map_odom is None
        return (self._pose_fault if is_waiting else '') or fault

    def _offset_ns(self, stamp_ns: int) -> int:
        """Time by which a stamp is ahead of the last one of the odometry; 0 without odometry."""
        latest_ns = self._odometry.latest_stamp_ns
        return 0 if latest_ns is None else stamp_ns - latest_ns

    def _record(self, stream: InputStream, stamp_ns: int) -> None:
        time = self._time
        stream.add(stamp_ns, time.now_ns(), time.age_ns(stamp_ns))


def _offset_fault(source: str, offset_ns: int) -> str:
    """What is wrong with stamps that are ahead of those of the odometry; '' for nothing."""
    if abs(offset_ns) <= SENSOR_TIMEOUT_NS:
        return ''
    side = 'ahead of' if offset_ns > 0 else 'behind'
    return (
        f"{source} stamps are {abs(offset_ns) / SECOND_NS:.1f} s {side} odometry's: expected at "
        f'most {SENSOR_TIMEOUT_NS / SECOND_NS:.1f} s'
    )


_MAX_POSES = 10_000


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
    """Reads goals of Nav2's actions, in any frame that transforms connect to the map.

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
        """T_map_frame (3,) at a stamp, or shortly before it; the newest for stamp 0."""
        own = self._map_frame
        try:
            return self._transforms.lookup_lately(own, frame, stamp_ns, self._tolerance_ns)
        except InputError as error:
            expected = f'expected a frame connected to "{own}"'
            raise _TransformError(f'frame {quoted(frame)}: {error}: {expected}') from error

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


@dataclass(frozen=True)
class GiveWayConfig(Config):
    """How near another robot may come."""

    give_way_m: float = parameter(
        0.61,
        'The robot does not drive nearer to another robot of the team than this, from centre to '
        'centre (m). Set it to the sum of the radii of both and 0.11.',
        low=0.0,
        high=10.0,
    )


class TeamDriving:
    """What a navigator knows of the other robots; without a team, nothing.

    It drives over the ground that they know, too, and with right of way.
    """

    def __init__(self, node: ThinmapNode) -> None:
        """Declare the parameters."""
        self._heard = heard_robots(node)
        self._distance_m = parameters.declare_config(node, GiveWayConfig).give_way_m
        self._tiles: TileReceiver | None = None
        if self._heard is not None:
            self._tiles = TileReceiver(node, self._heard.places, self._heard.name)

    def completed(self, own: GridPatch) -> GridPatch:
        """The map of this robot, and what others know where it is undecided."""
        return own if self._tiles is None else self._tiles.completed(own)

    def allowed(
        self, navigator: Navigator, T_map_base: Array, command: Command, dt_s: float
    ) -> Command:
        """The command, or one that gives way where the robot would come too near to another one.

        T_map_base (3,): pose of the robot; dt_s: time between two commands.
        """
        if self._heard is None:
            return command
        own = Motion(self._heard.name, T_map_base, command.v, command.w)
        return navigator.allowed(own, command, self._heard.motions(), self._distance_m, dt_s)
