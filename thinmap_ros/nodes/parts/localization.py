"""Parts of the localizer: its map, given or restored, poses in it, keyframes, AMCL's interface."""

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from nav2_msgs.msg import Particle, ParticleCloud
from nav2_msgs.srv import SetInitialPose
from rclpy.node import Node
from std_srvs.srv import Empty

from thinmap_msgs.msg import Keyframe, KeyframePoses, SlamStatus
from thinmap_msgs.srv import LocalizeGlobally
from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import Config, parameter, part
from thinmap_ros.core.errors import ConfigError, InputError, quoted
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.odometry import FIELDS, OdometryAnchor
from thinmap_ros.core.se2 import MAX_COORDINATE_M, Array, rotated_covariance
from thinmap_ros.core.slam.graph.keyframes import SavedKeyframes
from thinmap_ros.core.slam.joining.messages import KeyframeSender
from thinmap_ros.core.slam.localizer import TAG, AnyLocalizer, Localizer, localizer_class
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.snapshot import MAX_COUNT, Field, State
from thinmap_ros.core.stage import Estimate, StartConfig, config_at
from thinmap_ros.files import sessions
from thinmap_ros.files.occupancy_maps import read_map
from thinmap_ros.files.safe import read_mapping, write_text
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.checkpoint import own_file_name
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.maps import new_map_id, subscribe_to_map
from thinmap_ros.ros.subscription import subscribe_guarded
from thinmap_ros.ros.tf import TransformListener

# Of a pose that a user gives: standard deviations of 0.5 m and 15 degrees, as in RViz.
GIVEN_COVARIANCE = np.diag([0.25, 0.25, 0.0685])


@dataclass(frozen=True)
class InitialPoseConfig(Config):
    """A pose in the map; z is there for parameter files of AMCL and is not used."""

    x: float = parameter(0.0, 'Position in the map (m).', low=-MAX_COORDINATE_M)
    y: float = parameter(0.0, 'Position in the map (m).', low=-MAX_COORDINATE_M)
    z: float = parameter(0.0, 'Height (m). Not used: the map is planar.')
    yaw: float = parameter(0.0, 'Heading in the map (rad).')

    @property
    def pose(self) -> Array:
        """The pose T_map_base (3,)."""
        return se2.pose(self.x, self.y, self.yaw)


@dataclass(frozen=True)
class LocalizationConfig(Config):
    """Parameters of the mode localization."""

    map_file_name: str = parameter(
        '',
        'map_server YAML file of the map, for mode localization. Empty: the map of session_path; '
        'without one, the map is that of topic map.',
    )
    set_initial_pose: bool = parameter(
        False,
        'In mode localization, start at initial_pose instead of the last pose of the previous '
        'run. Set it where the robot always starts at the same place.',
    )
    always_reset_initial_pose: bool = parameter(
        False,
        'In mode localization, return to initial_pose with each new map instead of keeping the '
        'pose. Only with set_initial_pose.',
    )
    first_map_only: bool = parameter(
        False,
        'In mode localization, ignore all but the first message of topic map. Set it where another '
        'node draws into the map that the robot was placed in.',
    )
    save_pose_rate: float = parameter(
        0.5,
        'Rate at which the last pose is saved for the next start in mode localization (1/s), and '
        'at the end. 0 or less: it is not saved. Raise it where the robot is switched off while it '
        'drives.',
        low=-1.0,
        high=10.0,
    )
    pose_file: str = parameter(
        '',
        'File for the last pose. Empty: below $XDG_STATE_HOME/thinmap (~/.local/state/thinmap), '
        'named after ROS domain and node.',
    )
    initial_pose: InitialPoseConfig = part(InitialPoseConfig)


# A robot farther away sees nothing of the map: the range of long lasers.
_MARGIN_M = 30.0


def require_near_map(T_map_base: Array, localizer: AnyLocalizer) -> None:
    """Raise InputError unless a pose (3,) is near the map of a localizer, if that has one."""
    places = localizer.known_places()
    if not len(places):
        return
    place = T_map_base[:2]
    away = place - np.clip(place, places.min(axis=0), places.max(axis=0))
    away_m = float(np.hypot(*away))
    if away_m > _MARGIN_M:
        x, y = place.tolist()
        raise InputError(
            f'pose at {x:.1f}, {y:.1f} m, {away_m:.1f} m from the map: '
            f'expected a place in the map or within {_MARGIN_M:.0f} m of it'
        )


_STAMPS = 'keyframe_stamps_ns'
_CALIBRATION = 'calibration'
_OF_ODOMETRY = Field(np.float64, (5, 4), -10.0, 10.0)
_NEWER = 'newer_'  # begins the names of what the pose is saved with


class Recovery:
    """The checkpoint of a localizer: its map, saved seldom, and its pose in it, saved often.

    With the pose, the keyframes are saved that the saved map does not have. The pose is relative to
    the newest one: corrections move both.

    last: the anchor of the last scan at a known place; is_map_saved: whether the map has been;
    awaited: where a localizer that was killed has to continue with its next scan; None once it has.
    """

    def __init__(self, awaited: OdometryAnchor | None = None) -> None:
        self.last: OdometryAnchor | None = None
        self.awaited = awaited
        self.is_map_saved = False
        self._newest_ns = 0  # stamp of the last keyframe of the saved map

    def map_state(self, localizer: AnyLocalizer) -> State:
        """The map: keyframes with their stamps, or where it is not made of these, its cells."""
        keyframes = localizer.saved_keyframes() if isinstance(localizer, Localizer) else None
        self.is_map_saved = True
        self._newest_ns = 0 if keyframes is None else keyframes.stamps_ns[-1]
        if keyframes is None or not isinstance(localizer, Localizer):
            return localizer.state()
        return {
            **_packed(keyframes),
            _CALIBRATION: localizer.calibration,
            **localizer.tag_state(),
        }

    def pose_state(self, localizer: AnyLocalizer) -> State | None:
        """The last known pose, and the keyframes since the map was saved; None before the first."""
        if self.last is None:
            return None
        newer = None
        if self._newest_ns and isinstance(localizer, Localizer):
            newer = localizer.saved_keyframes(self._newest_ns)
        if newer is None:
            return self.last.state()
        anchor = newer.frames[-1].T_map_base
        relative = replace(self.last, T_map_odom=se2.between(anchor, self.last.T_map_odom))
        packed = {_NEWER + name: array for name, array in _packed(newer).items()}
        return {**relative.state(), **packed}


def restored(state: State, config: StartConfig) -> tuple[AnyLocalizer | None, OdometryAnchor]:
    """Localizer at the start pose in a saved map, and where it was in this.

    None in mode localization: the map does not change, and is given again. Raises InputError for a
    state that is none of this configuration.
    """
    pose, own = snapshot.split(state, FIELDS)
    last = OdometryAnchor.from_state(pose)
    if not config.is_mapping:
        return None, last
    if not isinstance(config, LocalizerConfig):
        return localizer_class(config).from_state(own, config), last
    tag, own = snapshot.split_text(own, TAG)
    config = replace(config, map_tag=tag or config.map_tag)
    if _STAMPS not in own:
        return Localizer.from_state(own, config), last
    learned, own = snapshot.split(own, [_CALIBRATION])
    calibration = _calibration(learned)
    newer, own = snapshot.split_prefix(own, _NEWER)
    keyframes = _unpacked(own)
    if newer:
        tail = _unpacked(newer)
        if tail.stamps_ns[0] == keyframes.stamps_ns[-1]:
            keyframes = keyframes.extended(tail)
        poses = {frame.scan.stamp_ns: frame.T_map_base for frame in keyframes.frames}
        newest_ns = tail.stamps_ns[-1]
        snapshot.require(newest_ns in poses, f'keyframes: none of {newest_ns} ns', 'one')
        last = replace(last, T_map_odom=se2.compose(poses[newest_ns], last.T_map_odom))
    return Localizer.from_keyframes(keyframes, calibration, config), last


def _calibration(state: State) -> Array:
    found = snapshot.validate(state, {_CALIBRATION: _OF_ODOMETRY}, 'odometry')[_CALIBRATION]
    covariance = found[1:]
    is_one = np.allclose(covariance, covariance.T) and np.linalg.eigvalsh(covariance).min() > 0.0
    snapshot.require(bool(is_one), f'odometry: {_CALIBRATION}', 'a covariance')
    return found


def _packed(keyframes: SavedKeyframes) -> State:
    return {**keyframes.state(), _STAMPS: np.array(keyframes.stamps_ns)}


def _unpacked(state: State) -> SavedKeyframes:
    stamps, keyframes = snapshot.split(state, [_STAMPS])
    saved = SavedKeyframes.from_state(keyframes)
    fields = {_STAMPS: Field(np.int64, (len(saved.frames),), 0, MAX_COUNT)}
    return saved.with_stamps(snapshot.validate(stamps, fields, 'keyframes')[_STAMPS].tolist())


class KeyframeOutput:
    """Topics keyframes, a message each, and keyframe_poses after a correction, both latched.

    They are for a map of several robots.
    At most one keyframe with each scan: those of a loaded map follow one after another.
    """

    def __init__(self, node: Node, map_frame: str) -> None:
        self._frame = map_frame
        self._keyframes = node.create_publisher(Keyframe, 'keyframes', qos.KEYFRAMES)
        self._poses = node.create_publisher(KeyframePoses, 'keyframe_poses', qos.LATCHED)
        self._sender: KeyframeSender | None = None
        self._session = 0

    def publish(self, stamp_ns: int, localizer: AnyLocalizer, map_id: int) -> None:
        """Publish what is new since the last scan; stamp_ns: of this one."""
        graph = localizer.published_graph if isinstance(localizer, Localizer) else None
        if graph is None:
            self._sender = None
            return
        if self._sender is None or self._sender.loops is not graph:
            self._sender = KeyframeSender(graph)
            self._session = new_map_id()
        header = messages.header(self._frame, stamp_ns)
        poses = self._sender.corrected_poses()
        if poses is not None:
            self._poses.publish(
                KeyframePoses(
                    header=header,
                    session=self._session,
                    revision=self._sender.revision,
                    poses=poses.ravel().tolist(),
                )
            )
        message = self._sender.next_message()
        if message is not None:
            self._keyframes.publish(
                Keyframe(
                    header=header,
                    map_id=map_id,
                    session=self._session,
                    layout=Keyframe.LAYOUT,
                    data=message.encode(),
                )
            )


_SAMPLES = 200
_SHOWN = 1000  # hypotheses of the global localizer
_WARN_PERIOD_S = 30.0


class AmclInterface:
    """The interface of AMCL, in mode localization: amcl_pose, particle_cloud, and services.

    amcl_pose: the last known pose: none is published while the robot is lost. particle_cloud:
    samples of the posterior; while the robot is lost, the samples of the global localizer.
    request_nomotion_update publishes both again; scans are matched while the robot stands, too.
    """

    def __init__(
        self,
        node: ThinmapNode,
        map_frame: str,
        set_pose: Callable[[PoseWithCovarianceStamped], None],
    ) -> None:
        """set_pose: takes an initial pose in any frame; raises InputError."""
        self._node = node
        self._map_frame = map_frame
        self._set_pose = set_pose
        self._last: tuple[int, Estimate] | None = None
        self._pose = node.create_publisher(PoseWithCovarianceStamped, 'amcl_pose', qos.LATCHED)
        self._cloud = node.create_publisher(ParticleCloud, 'particle_cloud', qos.SENSOR)
        self._search = node.create_client(LocalizeGlobally, 'localize_globally')
        subscribe_guarded(node, PoseArray, 'localization_samples', self._on_samples, qos.LATCHED)
        node.create_service(SetInitialPose, 'set_initial_pose', self._on_set_pose)
        node.create_service(Empty, 'reinitialize_global_localization', self._on_search)
        node.create_service(Empty, 'request_nomotion_update', self._on_update)

    @property
    def has_published(self) -> bool:
        """Whether there was an estimate in a map."""
        return self._last is not None

    def publish(self, stamp_ns: int, estimate: Estimate) -> None:
        """Publish the estimate of a scan."""
        self._last = (stamp_ns, estimate)
        if estimate.is_lost:
            return
        self._pose.publish(messages.estimate_msg(estimate, self._map_frame, stamp_ns))
        if self._cloud.get_subscription_count():
            self._cloud.publish(self._posterior(stamp_ns, estimate))

    def _posterior(self, stamp_ns: int, estimate: Estimate) -> ParticleCloud:
        rng = np.random.default_rng(stamp_ns)
        samples = rng.multivariate_normal(
            estimate.T_map_base, estimate.covariance, _SAMPLES, check_valid='ignore'
        )
        weight = 1.0 / _SAMPLES
        return ParticleCloud(
            header=messages.header(self._map_frame, stamp_ns),
            particles=[Particle(pose=messages.pose_msg(T), weight=weight) for T in samples],
        )

    def _on_samples(self, message: PoseArray) -> None:
        is_lost = self._last is None or self._last[1].is_lost
        if not (is_lost and message.poses and self._cloud.get_subscription_count()):
            return
        poses = message.poses[:: -(-len(message.poses) // _SHOWN)]
        weight = 1.0 / len(poses)
        self._cloud.publish(
            ParticleCloud(
                header=message.header,
                particles=[Particle(pose=pose, weight=weight) for pose in poses],
            )
        )

    def _on_set_pose(
        self, request: SetInitialPose.Request, response: SetInitialPose.Response
    ) -> SetInitialPose.Response:
        try:
            self._set_pose(request.pose)
        except InputError as error:
            self._node.diagnostics.message_rejected('set_initial_pose', str(error))
            self._node.get_logger().warning(f'set_initial_pose: {error}')
        return response

    def _on_search(self, _: Empty.Request, response: Empty.Response) -> Empty.Response:
        if self._search.service_is_ready():
            self._search.call_async(LocalizeGlobally.Request(discard_hypotheses=True))
        else:
            self._node.get_logger().warning(
                'reinitialize_global_localization: global_localizer is not running'
            )
        return response

    def _on_update(self, _: Empty.Request, response: Empty.Response) -> Empty.Response:
        if self._last is not None:
            self.publish(*self._last)
        return response


_KEYS = ('x', 'y', 'yaw')


class LastPose:
    """A small YAML file with the map and the last pose in it; it survives a restart."""

    def __init__(self, node: Node, path: str, rate: float, map_name: str) -> None:
        """path: '' for the default; rate: of saving, 1/s; map_name: the pose belongs to it."""
        self._node = node
        self._path = Path(path) if path else _default_path(node)
        self._period_s = 1.0 / rate if rate > 0.0 else math.inf
        self._map_name = map_name
        self._saved_at_s = -math.inf
        self._unsaved: Array | None = None

    def load(self) -> Array | None:
        """The pose (3,) in this map; None without one: no file, a broken one, or another map."""
        if math.isinf(self._period_s) or not self._path.exists():
            return None
        try:
            content = read_mapping(self._path, 'the last pose of a localizer')
            pose = self._pose_of(content)
        except InputError as error:
            self._node.get_logger().warning(f'{error}: starting without a last pose')
            return None
        named = content.get('map')
        if named == self._map_name:
            return pose
        self._node.get_logger().info(
            f'{self._path}: pose in map {quoted(named)}, not in {quoted(self._map_name)}: '
            'starting without a last pose'
        )
        return None

    def save(self, T_map_base: Array) -> None:
        """Save a pose (3,), unless the last one was saved recently."""
        if math.isinf(self._period_s):
            return
        self._unsaved = T_map_base
        if time.monotonic() - self._saved_at_s >= self._period_s:
            self.save_latest()

    def save_latest(self) -> None:
        """Save the pose that was given last, if it is not saved: at the end of the node."""
        if self._unsaved is None:
            return
        self._saved_at_s = time.monotonic()
        values = zip(_KEYS, (round(value, 4) for value in self._unsaved.tolist()), strict=True)
        self._unsaved = None
        try:
            write_text(self._path, yaml.safe_dump({'map': self._map_name, **dict(values)}))
        except OSError as error:
            self._node.get_logger().warning(
                f'pose_file: {error.filename or self._path}: {error.strerror}: '
                'last pose not saved: expected a file that can be written',
                throttle_duration_sec=_WARN_PERIOD_S,
            )

    def _pose_of(self, content: dict[str, object]) -> Array:
        values = [content.get(key) for key in _KEYS]
        numbers = [float(value) for value in values if isinstance(value, int | float)]
        if len(numbers) != len(_KEYS) or not se2.is_bounded_pose(se2.pose(*numbers)):
            raise InputError(f'{self._path}: expected x, y (m) and yaw (rad)')
        return se2.pose(*numbers)


def _default_path(node: Node) -> Path:
    state = os.environ.get('XDG_STATE_HOME') or Path.home() / '.local' / 'state'
    return Path(state, 'thinmap', own_file_name(node, '.pose.yaml'))


class GivenMap:
    """The given map: of a file, a session, or a topic; poses to start from, and AMCL's interface.

    In mode mapping, a session. config: of the next localizer; has_loaded: whether a service has
    loaded another map. Poses in other frames are transformed by the newest transforms.
    """

    def __init__(self, node: ThinmapNode, config: StartConfig) -> None:
        """Declare the parameters.

        Raises ConfigError where the parameters contradict each other, InputError for a file.
        """
        self._node = node
        self.config = config
        self.has_loaded = False
        self._settings = parameters.declare_config(node, LocalizationConfig)
        self._report = node.get_logger().warning
        self._session = parameters.declare_session(node)
        self._patch = self._read_file()
        name = self._settings.map_file_name or self._session or 'topic map'
        self._is_topic = not config.is_mapping and name == 'topic map'
        self._last_pose = LastPose(
            node, self._settings.pose_file, self._settings.save_pose_rate, name
        )
        node.add_end_callback(self._last_pose.save_latest)
        self._amcl: AmclInterface | None = None
        self._given_covariance: Array | None = None  # of an initial pose without a map

    @property
    def has_map(self) -> bool:
        """Whether there is a map, or none is needed."""
        is_given = bool(self._session) or self.has_loaded or self._patch is not None
        return self.config.is_mapping or is_given

    def subscribe_to_poses(
        self,
        map_frame: str,
        on_pose: Callable[[Array, Array], None],
        transform_received: Callable[[Any, bool], None],
    ) -> None:
        """Subscribe to initialpose; in mode localization, offer AMCL's topics and services.

        on_pose: receives pose (3,) and covariance (3, 3), map frame. transform_received: is called
        with each transform, and whether it is static.
        """
        transforms = TransformListener(self._node, transform_received)

        def add_pose(message: PoseWithCovarianceStamped) -> None:
            pose = messages.pose_from_msg(message.pose.pose)
            covariance = messages.covariance_from_msg(message)
            frame = message.header.frame_id.lstrip('/')
            if frame not in ('', map_frame):
                T_map_frame = _transform_to(map_frame, frame, transforms)
                pose = se2.compose(T_map_frame, pose)
                covariance = rotated_covariance(covariance, float(T_map_frame[2]))
            on_pose(pose, covariance)

        subscribe_guarded(
            self._node, PoseWithCovarianceStamped, 'initialpose', add_pose, qos.STREAM
        )
        if not self.config.is_mapping:
            self._amcl = AmclInterface(self._node, map_frame, add_pose)

    def subscribe_to_map(self, changed: Callable[[], None]) -> None:
        """Subscribe to topic map if the map is to come from there; changed: there is a new one."""
        if not self._is_topic:
            return

        def on_map(patch: GridPatch) -> None:
            known = self._patch
            if known is not None and (
                self._settings.first_map_only
                or (known.frame == patch.frame and np.array_equal(known.cells, patch.cells))
            ):
                return
            self._patch = patch
            changed()

        subscribe_to_map(self._node, 'map', on_map)

    def first_localizer(self) -> AnyLocalizer:
        """A localizer at the start pose.

        It is initial_pose where set, else the start pose where it is not 0, else the last pose.
        """
        self._given_covariance = None
        if self.config.is_mapping:
            return self.localizer_at()
        if self._settings.set_initial_pose:
            return self.localizer_at(self._settings.initial_pose.pose, GIVEN_COVARIANCE)
        last = None if self.config.is_start_given else self._last_pose.load()
        if last is not None:
            x, y, yaw = last.tolist()
            self._node.get_logger().info(f'last pose: {x:.2f}, {y:.2f} m, {yaw:.2f} rad')
        return self.localizer_at(last)

    def localizer_at(
        self, T_map_base: Array | None = None, covariance: Array | None = None
    ) -> AnyLocalizer:
        """A localizer in the map, at a pose (3,), None for the configured one.

        covariance (3, 3): of a pose that somebody has given; without one, a localizer in a given
        map is delocalized until scans fit. Raises InputError for a session that is broken.
        """
        config = self.config if T_map_base is None else config_at(self.config, T_map_base)
        localizer = self._in_map(config)
        if T_map_base is not None and covariance is not None:
            localizer.set_pose(T_map_base, covariance)
        return localizer

    def with_new_map(self, localizer: AnyLocalizer) -> AnyLocalizer:
        """The localizer that follows another one in a map from its topic."""
        settings = self._settings
        covariance = self._given_covariance
        self._given_covariance = None
        if covariance is not None:
            placed = self.localizer_at(localizer.pose, covariance)
            try:
                require_near_map(placed.pose, placed)
                return placed
            except InputError as error:
                self._node.diagnostics.message_rejected('initialpose', str(error))
                self._node.get_logger().warning(f'initialpose: {error}')
        is_first = self._amcl is None or not self._amcl.has_published
        if is_first or (settings.set_initial_pose and settings.always_reset_initial_pose):
            return self.first_localizer()
        return self.localizer_at(localizer.pose)

    def pose_set(self, covariance: Array) -> None:
        """A user has given a pose, with a covariance (3, 3)."""
        if not self.has_map:
            self._given_covariance = covariance

    def publish(self, stamp_ns: int, estimate: Estimate, state: int) -> None:
        """Publish the estimate of a scan with AMCL's interface, and save the pose if known."""
        if self._amcl is None:
            return
        logger = self._node.get_logger()
        if state == SlamStatus.NO_MAP:
            text = 'no map: waits for topic map'
            logger.warning(text, throttle_duration_sec=_WARN_PERIOD_S)
            return
        self._amcl.publish(stamp_ns, estimate)
        if state == SlamStatus.TRACKING:
            self._last_pose.save(estimate.T_map_base)
        elif state == SlamStatus.LOST:
            text = 'lost: waits for initialpose, a global localization, or a scan that matches'
            logger.warning(text, throttle_duration_sec=_WARN_PERIOD_S)

    def _read_file(self) -> GridPatch | None:
        """The map of map_file_name, None where there is none; checks the parameters."""
        file = self._settings.map_file_name
        if self.config.is_mapping:
            if file:
                raise ConfigError('map_file_name is given: expected mode = localization')
            return None
        if not self._session and not isinstance(self.config, LocalizerConfig):
            raise ConfigError(
                f'mode = localization with slam = {self.config.slam}: expected a session_path with '
                'its line features'
            )
        return read_map(Path(file), report=self._report) if file else None

    def _in_map(self, config: StartConfig) -> AnyLocalizer:
        """A localizer at the configured pose, delocalized if in a given map."""
        if self._patch is not None and isinstance(config, LocalizerConfig):
            return Localizer.in_occupancy_map(self._patch, config)
        if self._session:
            loaded = sessions.load_localizer(self._session, config, report=self._report)
            if loaded is not None:
                return loaded
        return localizer_class(config)(config)


def _transform_to(map_frame: str, frame: str, transforms: TransformListener) -> Array:
    """T_map_frame (3,). Raises InputError with what was expected where it is unknown."""
    try:
        return transforms.lookup(map_frame, frame)
    except InputError as error:
        expected = f'expected a frame connected to {quoted(map_frame)}'
        raise InputError(f'frame {quoted(frame)}: {error}: {expected}') from error
