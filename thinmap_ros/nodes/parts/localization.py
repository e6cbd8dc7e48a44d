"""Parts of the localizer: its parameters, recovery, keyframes and the area that it knows."""

from dataclasses import dataclass, replace

import numpy as np
from rclpy.node import Node

from thinmap_msgs.msg import Keyframe, KeyframePoses
from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import Config, parameter, part
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.odometry import FIELDS, OdometryAnchor
from thinmap_ros.core.se2 import MAX_COORDINATE_M, Array
from thinmap_ros.core.slam.graph.keyframes import SavedKeyframes
from thinmap_ros.core.slam.joining.messages import KeyframeSender
from thinmap_ros.core.slam.localizer import TAG, AnyLocalizer, Localizer, localizer_class
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.snapshot import MAX_COUNT, Field, State
from thinmap_ros.core.stage import StartConfig
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.maps import new_map_id

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
