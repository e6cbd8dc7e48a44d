"""The pose of the laser on the robot, from /tf_static or from a parameter."""

import math
from collections.abc import Callable
from functools import partial

from rclpy.node import Node
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from thinmap_ros.core.errors import ConfigError, InputError, quoted
from thinmap_ros.core.scan import LaserConfig, Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.logs.transforms import Mount, StaticTransforms, parse_pose
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.diagnostics import WARN
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import subscribe_guarded
from thinmap_ros.ros.tf import TransformReader


class LaserTransform:
    """The pose of each laser frame on the robot.

    It is looked up in the static transforms, as for bags. For a robot that does not publish them,
    the parameter `laser_pose` [x m, y m, yaw rad] is used for every frame. There is no default.
    The first pose of a frame is kept: the map was made with it. Another one is reported on
    /diagnostics. base_frame, scan_topics: values of the parameters base_frame and scan_topic. Of
    several topics, each is that of other lasers.
    """

    def __init__(self, node: Node) -> None:
        self.base_frame = str(
            parameters.declare_parameter(
                node, 'base_frame', 'base_link', 'Frame of the robot (REP 105).'
            )
        )
        given = parameters.declare_parameter(
            node,
            'laser_pose',
            '',
            'Pose of the laser on the robot as "x,y,yaw" (m, m, rad). Empty: from /tf_static.',
        )
        self.scan_topics = parameters.declare_texts(
            node,
            'scan_topic',
            'scan',
            'Topic of the scans, as for slam_toolbox and AMCL; of several lasers a list: '
            '[front/scan, rear/scan].',
        )
        names = [node.resolve_topic_name(topic) for topic in self.scan_topics]
        if len(set(names)) < len(names):
            raise ConfigError(f'scan_topic: {", ".join(names)}: expected different topics')
        if given and len(self.scan_topics) > 1:
            raise ConfigError(
                f'laser_pose {quoted(str(given))} with {len(self.scan_topics)} topics in scan_topic'
                ': expected no pose: that of each laser is from /tf_static'
            )
        self._laser = parameters.declare_config(node, LaserConfig)
        self._fixed = Mount(parse_pose(str(given)), upside_down=False) if given else None
        self._transforms = StaticTransforms()
        self._reader = TransformReader(lambda frame: frame in self._mounts)
        self._mounts: dict[str, Mount] = {}
        self._changes: dict[str, str] = {}
        self._topics: dict[str, str] = {}  # of each laser frame
        self._node = node
        self._first_ns: dict[str, int] = {}  # stamp of the first scan of each topic
        self._described: set[str] = set()  # topics
        if isinstance(node, ThinmapNode):
            node.diagnostics.add_check(WARN, lambda: '; '.join(self._changes.values()))
        if self._fixed is None:
            node.create_subscription(
                TFMessage, '/tf_static', self._on_static, qos.STATIC_TRANSFORMS, raw=True
            )

    def subscribe(self, node: ThinmapNode, process: Callable[[str, LaserScan], None]) -> None:
        """Call `process` with topic and message of each scan, as `subscribe_guarded`."""
        for topic in self.scan_topics:
            subscribe_guarded(node, LaserScan, topic, partial(process, topic), qos.SENSOR)

    def to_scan(self, topic: str, message: LaserScan) -> Scan:
        """Scan of a message on a topic, with the pose of its laser.

        Raises InputError where the pose is unknown, the message is no scan, or another topic has
        scans in its frame.
        """
        mount = self._mount(message.header.frame_id)
        if mount is None:
            raise InputError(
                f'scan in frame {quoted(message.header.frame_id)}: no static transform from '
                f'"{self.base_frame}" to it; publish one on /tf_static or set the parameter '
                'laser_pose'
            )
        scan = messages.scan_from_msg(message, mount.T_base_laser, self._laser)
        self._require_own_frame(topic, scan.frame)
        self._describe(topic, scan)
        return mount.apply(scan)

    def pose(self, frame_id: str) -> Array | None:
        """T_base_laser (3,) of a laser frame; None until it is known."""
        mount = self._mount(frame_id)
        return None if mount is None else mount.T_base_laser

    def _describe(self, topic: str, scan: Scan) -> None:
        """Log what the first scans are, once there are two: with one, their rate is unknown."""
        if topic in self._described:
            return
        first_ns = self._first_ns.get(topic)
        if first_ns is None or scan.stamp_ns <= first_ns:
            self._first_ns[topic] = scan.stamp_ns
            return
        self._described.add(topic)
        beams = scan.ranges_m.size
        angle_deg = math.degrees(abs(scan.angle_increment_rad)) * (beams - 1)
        rate_hz = 1e9 / (scan.stamp_ns - first_ns)
        self._node.get_logger().info(
            f'first scans on {self._node.resolve_topic_name(topic)}: {beams} beams over '
            f'{angle_deg:.0f} degrees, {rate_hz:.3g} Hz, up to {scan.range_max_m:.3g} m'
        )

    def _require_own_frame(self, topic: str, frame: str) -> None:
        """Raise InputError where the frame of a scan is that of another topic."""
        if len(self.scan_topics) == 1:
            return
        known = self._topics.setdefault(frame, topic)
        if known != topic:
            raise InputError(
                f'scan in frame {quoted(frame)}, as those on {known}: expected a frame of its own '
                'for each laser'
            )

    def _mount(self, frame_id: str) -> Mount | None:
        if self._fixed is not None:
            return self._fixed
        if frame_id not in self._mounts:
            found = self._transforms.laser_mount(frame_id, self.base_frame)
            if found is None:
                return None
            self._mounts[frame_id] = found
        return self._mounts[frame_id]

    def _on_static(self, data: bytes) -> None:
        # The frames of an invalid message stay unknown.
        self._reader.feed(data, self._transforms.add, lambda _: None)
        self._changes = {
            frame: f'static transform of laser {quoted(frame)} {change}: the first one is used; '
            'expected a laser that does not move on the robot: restart the node for the new one'
            for frame in self._mounts
            if (change := self._transforms.change(frame, self.base_frame))
        }
