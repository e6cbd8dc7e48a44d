"""What a localizer that was killed continues with: its map, and where the robot was in it."""

from dataclasses import replace

import numpy as np

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.odometry import FIELDS, OdometryAnchor
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import SavedKeyframes
from thinmap_ros.core.slam.localizer import AnyLocalizer, Localizer, localizer_class
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.snapshot import MAX_COUNT, Field, State
from thinmap_ros.core.stage import StartConfig

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
        return {**_packed(keyframes), _CALIBRATION: localizer.calibration}

    def pose_state(self, localizer: AnyLocalizer) -> State | None:
        """The last known pose, and the keyframes since the map was saved; None before the first."""
        newest_ns = self._newest_ns
        newer = None
        if newest_ns and isinstance(localizer, Localizer):
            newer = localizer.saved_keyframes(newest_ns)
        if self.last is None:
            return None
        if newer is None:
            return self.last.state()
        anchor = newer.frames[-1].T_map_base
        relative = replace(self.last, T_map_odom=se2.between(anchor, self.last.T_map_odom))
        packed = {_NEWER + name: array for name, array in _packed(newer).items()}
        return {**relative.state(), **packed}


def restored(state: State, config: StartConfig) -> tuple[AnyLocalizer, OdometryAnchor]:
    """Localizer at the start pose in a saved map, and where it was in this.

    Raises InputError for a state that is none of this configuration.
    """
    last = saved_pose(state)
    own = {name: array for name, array in state.items() if name not in FIELDS}
    if _STAMPS not in own or not isinstance(config, LocalizerConfig):
        return localizer_class(config).from_state(own, config), last
    calibration = _calibration({n: own.pop(n) for n in [*own] if n == _CALIBRATION})
    newer = {name: array for name, array in own.items() if name.startswith(_NEWER)}
    keyframes = _unpacked({name: array for name, array in own.items() if name not in newer})
    if newer:
        tail = _unpacked({name.removeprefix(_NEWER): array for name, array in newer.items()})
        if tail.stamps_ns[0] == keyframes.stamps_ns[-1]:
            keyframes = keyframes.extended(tail)
        poses = {frame.scan.stamp_ns: frame.T_map_base for frame in keyframes.frames}
        newest_ns = tail.stamps_ns[-1]
        snapshot.require(newest_ns in poses, f'keyframes: none of {newest_ns} ns', 'one')
        last = replace(last, T_map_odom=se2.compose(poses[newest_ns], last.T_map_odom))
    return Localizer.from_keyframes(keyframes, calibration, config), last


def saved_pose(state: State) -> OdometryAnchor:
    """Pose of a state, relative to its newest keyframe if it has any.

    Raises InputError if it is invalid.
    """
    return OdometryAnchor.from_state(
        {name: array for name, array in state.items() if name in FIELDS}
    )


def _calibration(state: State) -> Array:
    found = snapshot.validate(state, {_CALIBRATION: _OF_ODOMETRY}, 'odometry')[_CALIBRATION]
    covariance = found[1:]
    is_one = np.allclose(covariance, covariance.T) and np.linalg.eigvalsh(covariance).min() > 0.0
    snapshot.require(bool(is_one), f'odometry: {_CALIBRATION}', 'a covariance')
    return found


def _packed(keyframes: SavedKeyframes) -> State:
    return {**keyframes.state(), _STAMPS: np.array(keyframes.stamps_ns)}


def _unpacked(state: State) -> SavedKeyframes:
    saved = SavedKeyframes.from_state({n: array for n, array in state.items() if n != _STAMPS})
    fields = {_STAMPS: Field(np.int64, (len(saved.frames),), 0, MAX_COUNT)}
    own = {_STAMPS: state[_STAMPS]} if _STAMPS in state else {}
    return saved.with_stamps(snapshot.validate(own, fields, 'keyframes')[_STAMPS].tolist())
