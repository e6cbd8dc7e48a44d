"""Transforms of a robot: read, listened to, and the one of the map that is published."""

import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from time import monotonic
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from tf2_msgs.msg import TFMessage

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.logs.frames import NONE, SOURCES, TF, TOPIC
from thinmap_ros.logs.transforms import OdometryFrames, TransformBuffer, TransformOdometry
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.diagnostics import WARN, full_name
from thinmap_ros.ros.executor import UNAWAITED, take_all
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import AdaptiveSubscription, subscribe_guarded

_RECENT_S = 3.0  # a source that publishes more rarely is one that has ended
_OWN_STAMPS = 2 * qos.QUEUED_TRANSFORMS.depth  # at most the depth is queued


class SoleBroadcaster:
    """Reports on /diagnostics that another node connects the same frames on /tf or /tf_static.

    A subscriber takes the transforms of both, and the robot jumps between two places. A transform
    with a stamp that this node has not published is of another node.
    """

    def __init__(self, node: ThinmapNode, frames: Iterable[tuple[str, str]]) -> None:
        """frames: parent and child of each transform that this node publishes."""
        self._node = node
        self._frames = [(parent.lstrip('/'), child.lstrip('/')) for parent, child in frames]
        self._stamps: deque[int] = deque(maxlen=_OWN_STAMPS)
        self._foreign = ''  # the transform, as text
        self._received_s = 0.0
        self._is_static = False
        # Publishers of a static one when it arrived, by their ids: names are discovered later.
        self._static_sources: set[bytes] = set()
        node.diagnostics.add_check(WARN, self._fault)

    def add_own(self, stamp_ns: int) -> None:
        """Add the stamp of transforms that this node publishes."""
        self._stamps.append(stamp_ns)

    def add(self, transform: Any, is_static: bool) -> None:
        """Add a geometry_msgs/TransformStamped that was received."""
        parent = transform.header.frame_id.lstrip('/')
        child = transform.child_frame_id.lstrip('/')
        is_same = any(child == own for _, own in self._frames) or (child, parent) in self._frames
        if not is_same:
            return
        if not is_static and messages.stamp_ns(transform.header.stamp) in self._stamps:
            return
        self._foreign = f'{parent} -> {child} on {_topic(is_static)}'
        self._received_s = monotonic()
        self._is_static = is_static
        self._static_sources = set(self._others('/tf_static')) if is_static else set()

    def _fault(self) -> str:
        others = self._others(_topic(self._is_static))
        if self._is_static:
            # It was sent once: it is there until one of its possible sources has ended.
            is_present = self._static_sources <= set(others)
        else:
            is_present = monotonic() - self._received_s < _RECENT_S
        if not self._foreign or not is_present:
            self._foreign = ''
            return ''
        names = ', '.join(sorted(set(others.values())))
        return (
            f'{self._foreign}: published by another node, too, one of {names}: '
            'stop it, or set publish_tf: false'
        )

    def _others(self, topic: str) -> dict[bytes, str]:
        """Full names of the nodes that publish a topic, but for this one, by publisher."""
        own = self._node.get_fully_qualified_name()
        infos = self._node.get_publishers_info_by_topic(self._node.resolve_topic_name(topic))
        names = {bytes(info.endpoint_gid): full_name(info) for info in infos}
        return {publisher: name for publisher, name in names.items() if name != own}


def _topic(is_static: bool) -> str:
    return '/tf_static' if is_static else '/tf'


@dataclass(frozen=True)
class BroadcastConfig(Config):
    """How map_frame -> odom_frame is published."""

    publish_tf: bool = parameter(
        True,
        'Publish the transform from map_frame to odom_frame on /tf. false: another node does.',
    )
    transform_publish_period: float = parameter(
        0.05,
        'Time between two transforms (s). 0: one with each scan. Lower it where lookups find a '
        'transform that is too old, raise it to save CPU.',
        low=0.0,
        high=10.0,
    )
    transform_tolerance: float = parameter(
        0.2,
        'Time by which transforms are dated into the future (s), so that lookups at the present '
        'time succeed. Raise it for slow scanners and networks, lower it where a late correction '
        'of the map must be seen at once.',
        low=0.0,
        high=10.0,
    )


class MapBroadcaster:
    """Publishes the last T_map_odom periodically, dated `transform_tolerance` ahead.

    For a robot without odometry, odom_frame -> base_frame is published, too: the identity.
    """

    def __init__(
        self, node: ThinmapNode, map_frame: str, odom_frame: str, identity_frame: str = ''
    ) -> None:
        """identity_frame: name of the base frame if nobody else publishes its transform."""
        self._node = node
        self._frames = [(map_frame, odom_frame)]
        if identity_frame:
            self._frames.append((odom_frame, identity_frame))
        self._config = parameters.declare_config(
            node, BroadcastConfig, self._on_config, live=('transform_tolerance',)
        )
        self._T_map_odom: Array | None = None
        self._sole: SoleBroadcaster | None = None
        self._timer: Timer | None = None
        if not self._config.publish_tf:
            return
        self._publisher = node.create_publisher(TFMessage, '/tf', qos.TRANSFORMS)
        self._sole = SoleBroadcaster(node, self._frames)
        if self._config.transform_publish_period > 0.0:
            # Only while there is a transform.
            self._timer = node.create_active_timer(
                self._config.transform_publish_period, self._publish
            )
            self._timer.cancel()

    def _on_config(self, config: BroadcastConfig) -> None:
        self._config = config

    def update(self, T_map_odom: Array) -> None:
        """Publish another transform (3,) from now on."""
        is_first = self._T_map_odom is None
        self._T_map_odom = T_map_odom
        if is_first and self._timer is not None:
            self._timer.reset()
        if self._config.publish_tf and (is_first or self._config.transform_publish_period == 0.0):
            self._publish()

    def received(self, transform: Any, is_static: bool) -> None:
        """A geometry_msgs/TransformStamped was received, of this node or another one."""
        if self._sole is not None:
            self._sole.add(transform, is_static)

    def reset(self) -> None:
        """Publish nothing until the next `update`."""
        self._T_map_odom = None
        if self._timer is not None:
            self._timer.cancel()

    def _publish(self) -> None:
        if self._T_map_odom is None:
            return
        ahead_ns = round(1e9 * self._config.transform_tolerance)
        stamp_ns = self._node.now_ns + ahead_ns
        if self._sole is not None:
            self._sole.add_own(stamp_ns)
        poses = [self._T_map_odom, np.zeros(3)]
        self._publisher.publish(
            TFMessage(
                transforms=[
                    messages.transform_msg(T, parent, child, stamp_ns)
                    for T, (parent, child) in zip(poses, self._frames, strict=False)
                ]
            )
        )


_MANY = 200  # frames; robots with arms and heads have fewer
_MAX_FRAMES = 10_000
_PERIOD_S = 1.0
# Layout of CDR, little endian, offsets from the end of its header of four bytes.
_LITTLE_ENDIAN = b'\x00\x01'
_HEADER = 4
_COUNT = struct.Struct('<I')
_STAMP_AND_SIZE = struct.Struct('<iII')
_NUMBERS = struct.Struct('<7d')


class TransformReader:
    """Reads the transforms of serialized tf2_msgs/TFMessage, of which it decodes what is needed.

    Decoding all of two thousand frames at 20 Hz takes more than half of a processor, in each node.
    Of more than 200 frames, those that are not used are read once a second. Frames beyond the first
    10,000 are not read.
    """

    def __init__(
        self, is_used: Callable[[str], bool], now_s: Callable[[], float] = monotonic
    ) -> None:
        """is_used: whether each transform to a child frame is needed."""
        self._is_used = is_used
        self._now_s = now_s
        self._read_s: dict[str, float] = {}

    def feed(
        self,
        data: bytes,
        add: Callable[[TransformStamped], object],
        on_error: Callable[[InputError], None],
    ) -> None:
        """Call `add` with each transform of a message that is due; it may raise InputError.

        on_error: receives what is wrong with the message, or with one of its transforms.
        """
        try:
            for transform in self.read(data):
                try:
                    add(transform)
                except InputError as error:
                    on_error(error)
        except InputError as error:
            on_error(error)

    def read(self, data: bytes) -> Iterator[TransformStamped]:
        """Transforms of a message that are due. Raises InputError if the message is invalid."""
        if data[:2] != _LITTLE_ENDIAN:
            yield from deserialize_message(data, TFMessage).transforms
            return
        try:
            yield from self._read(data)
        except (struct.error, UnicodeDecodeError) as error:
            raise InputError(f'message that is no tf2_msgs/TFMessage: {error}') from error

    def _read(self, data: bytes) -> Iterator[TransformStamped]:
        now_s = self._now_s()
        (count,) = _COUNT.unpack_from(data, _HEADER)
        at = _HEADER + _COUNT.size
        for _ in range(count):
            start = at
            *_, size = _STAMP_AND_SIZE.unpack_from(data, at)
            parent = at + _STAMP_AND_SIZE.size
            at = -(-(parent + size) // 4) * 4
            (child_size,) = _COUNT.unpack_from(data, at)
            child = at + _COUNT.size
            at = -(-(child + child_size - _HEADER) // 8) * 8 + _HEADER
            frame = data[child : child + child_size - 1].decode()
            if self._is_due(frame, now_s):
                numbers = _NUMBERS.unpack_from(data, at)
                stamp = _STAMP_AND_SIZE.unpack_from(data, start)[:2]
                yield _transform(stamp, data[parent : parent + size - 1].decode(), frame, numbers)
            at += _NUMBERS.size

    def _is_due(self, frame: str, now_s: float) -> bool:
        count = len(self._read_s)
        last_s = self._read_s.get(frame)
        if last_s is None and count >= _MAX_FRAMES:
            return False
        is_new = last_s is None or now_s - last_s >= _PERIOD_S
        if not (is_new or count <= _MANY or self._is_used(frame)):
            return False
        self._read_s[frame] = now_s
        return True


def _transform(
    stamp: tuple[int, int], parent: str, child: str, numbers: tuple[float, ...]
) -> TransformStamped:
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    message.header.stamp.sec, message.header.stamp.nanosec = stamp
    moved = message.transform.translation
    turned = message.transform.rotation
    moved.x, moved.y, moved.z = numbers[:3]
    turned.x, turned.y, turned.z, turned.w = numbers[3:]
    return message


@dataclass(frozen=True)
class OdometryInputConfig(Config):
    """Where odometry comes from."""

    odom_source: str = parameter(
        TOPIC,
        'Source of the odometry. topic: nav_msgs/Odometry on odom, in odom_frame and base_frame or '
        'in frames that static transforms connect to these. tf: the transform from odom_frame to '
        'base_frame. none: the robot has no odometry; the localizer follows it by '
        'scan matching alone and publishes odom_frame -> base_frame as identity.',
        choices=SOURCES,
    )


class OdometrySource:
    """Calls `process` with the stamp in ns and T_odom_base (3,) of each sample of the odometry.

    tilt_rad: of the robot at that sample; 0 where it is unknown.

    Without odometry the robot never moves in the odometry frame: there is a sample at the stamp of
    each scan, which the node reports by `add_scan_stamp`.
    """

    def __init__(
        self, node: ThinmapNode, base_frame: str, process: Callable[[int, Array], None]
    ) -> None:
        self.tilt_rad = 0.0
        self._scan_ns: int | None = None
        self._node = node
        self._process = process
        self.odom_frame = str(
            parameters.declare_parameter(
                node, 'odom_frame', 'odom', 'Frame of the odometry (REP 105).'
            )
        )
        self.source = parameters.declare_config(node, OdometryInputConfig).odom_source
        self._frames = OdometryFrames(
            self.odom_frame,
            base_frame,
            self._subscribe_static,
            lambda note: node.get_logger().info(f'odom: {note}'),
        )
        self._transforms = TransformOdometry(self.odom_frame, base_frame)
        self._readers = {
            is_static: TransformReader(self._transforms.is_used) for is_static in (False, True)
        }

    def subscribe(self) -> None:
        """Start to receive samples."""
        node = self._node
        if self.source == TOPIC:
            subscribe_guarded(node, Odometry, 'odom', self._on_odometry, qos.STREAM)
        elif self.source == TF:
            self._subscribe_static()
            AdaptiveSubscription(
                node, TFMessage, '/tf', self._on_transforms, qos.TRANSFORMS, raw=True
            )
            node.diagnostics.add_update_callback(self._report)

    def reset(self) -> None:
        """Forget the samples: the time was set back."""
        self._transforms.clear()

    def add_scan_stamp(self, stamp_ns: int) -> None:
        """A scan was made: without odometry, the robot is where it was."""
        if self.source == NONE and stamp_ns != self._scan_ns:
            self._scan_ns = stamp_ns
            self._process(stamp_ns, np.zeros(3))

    def _on_odometry(self, message: Odometry) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        T_odom_base = self._frames.pose(message)
        self.tilt_rad = self._frames.tilt_rad(message)
        self._process(stamp_ns, T_odom_base)

    def _subscribe_static(self) -> None:
        AdaptiveSubscription(
            self._node, TFMessage, '/tf_static', self._on_static, qos.STATIC_TRANSFORMS, raw=True
        )

    def _on_static(self, data: bytes, _info: dict[str, Any]) -> None:
        self._add(data, is_static=True)

    def _on_transforms(self, data: bytes, _info: dict[str, Any]) -> None:
        """Add transforms; the sample is that of the newest time at which all of them are known."""
        self._node.handle_time_jump()
        self._add(data, is_static=False)
        if not self._node.is_active:
            return
        try:
            sample = self._transforms.next_sample()
            if sample is not None:
                stamp_ns, T_odom_base, self.tilt_rad = sample
                self._process(stamp_ns, T_odom_base)
        except InputError as error:
            self._reject(error)

    def _add(self, data: bytes, is_static: bool) -> None:
        def add(transform: TransformStamped) -> None:
            self._transforms.add(transform, is_static)
            if is_static:
                self._frames.add_static(transform)

        self._readers[is_static].feed(data, add, self._reject)

    def _reject(self, error: InputError) -> None:
        self._node.diagnostics.message_rejected('/tf', str(error))

    def _report(self) -> None:
        """Report on /diagnostics what is missing of the chain of transforms."""
        missing = self._transforms.missing
        self._node.diagnostics.set_value('odometry by TF', missing or 'received')


_LOOKUP_STEP_NS = 20_000_000  # between two times that are tried


class TransformListener:
    """Transforms between the frames of a robot: a buffer that is filled from /tf and /tf_static.

    Messages of /tf, which are the most of all, wait in their queue: they are read by lookups, and
    once a second.
    """

    def __init__(
        self, node: Node, received: Callable[[Any, bool], None] = lambda transform, is_static: None
    ) -> None:
        """received: is called with each transform that is read, and whether it is static."""
        self._node = node
        self._received = received
        self._buffer = TransformBuffer()
        self._moving = self._subscribe('/tf', qos.QUEUED_TRANSFORMS, **UNAWAITED)
        self._subscribe('/tf_static', qos.STATIC_TRANSFORMS)
        if isinstance(node, ThinmapNode):
            node.diagnostics.add_update_callback(self._read)

    def lookup(self, target_frame: str, source_frame: str, stamp_ns: int | None = None) -> Array:
        """Pose of the source frame in the target frame, T_target_source (3,).

        stamp_ns: None for the newest. Raises InputError with the reason where it is unknown.
        """
        self._read()
        return self._buffer.lookup(target_frame, source_frame, stamp_ns)

    def lookup_lately(
        self, target_frame: str, source_frame: str, stamp_ns: int, tolerance_ns: int
    ) -> Array:
        """As `lookup`, at a stamp or up to a time before it; the newest for stamp 0, as in tf2."""
        reason: InputError | None = None
        for age_ns in range(0, tolerance_ns + 1, _LOOKUP_STEP_NS):
            try:
                return self.lookup(target_frame, source_frame, max(stamp_ns - age_ns, 0) or None)
            except InputError as error:
                reason = reason or error
        raise reason or InputError('transform_tolerance: expected at least 0 s')

    def clear(self) -> None:
        """Forget all but the static transforms: the time was set back."""
        self._read()
        self._buffer.clear()

    def _read(self) -> None:
        take_all(self._moving)

    def _subscribe(self, topic: str, profile: QoSProfile, **options: Any) -> Subscription:
        is_static = profile is qos.STATIC_TRANSFORMS
        reader = TransformReader(self._buffer.is_used)

        def add(transform: TransformStamped) -> None:
            self._received(transform, is_static)
            self._buffer.add(transform, is_static)

        def add_all(data: bytes) -> None:
            reader.feed(data, add, self._warn)

        return self._node.create_subscription(
            TFMessage, topic, add_all, profile, raw=True, **options
        )

    def _warn(self, error: InputError) -> None:
        self._node.get_logger().warning(f'/tf: {error}', throttle_duration_sec=5.0)
