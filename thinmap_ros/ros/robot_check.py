"""What a robot publishes, compared with what thinmap needs."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.ros import messages, qos, stop_topic, velocity
from thinmap_ros.ros.diagnostics import (
    NAME_END,
    SCALE_KEY,
    WARN,
    full_name,
    publisher_names,
    subscriber_names,
)

_MAX_DELAY_S = 1.0  # of a stamp against the clock, beyond which clocks differ
_MIN_RATE_HZ = 2.0
_MAX_MESSAGES = 10_000
_PERIOD_S = 0.1
_LISTENING = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


@dataclass(frozen=True)
class RobotNames:
    """Topics and frames of a robot, as of the parameters of the nodes.

    odom_topic: '' where the odometry is a transform, or there is none. is_mounted: the pose of the
    laser is a parameter.
    """

    scan_topics: tuple[str, ...] = ('scan',)
    odom_topic: str = 'odom'
    base_frame: str = 'base_link'
    odom_frame: str = 'odom'
    map_frame: str = 'map'
    is_mounted: bool = False


@dataclass(frozen=True)
class Finding:
    """One line of the table: what was looked at, what was seen, and what to do if it is wrong."""

    what: str
    is_good: bool
    seen: str
    advice: str = ''


class Checkup(NamedTuple):
    """What was found, and whether the robot is in the time of /clock, as a simulated one."""

    findings: list[Finding]
    is_simulated: bool

    @property
    def wrong(self) -> list[Finding]:
        """What is not as needed."""
        return [finding for finding in self.findings if not finding.is_good]


def table(findings: Sequence[Finding]) -> Iterator[str]:
    """Lines of findings, what to do below those that are wrong."""
    width = max(len(finding.what) for finding in findings)
    for finding in findings:
        mark = '\N{CHECK MARK}' if finding.is_good else '\N{BALLOT X}'
        yield f'{mark} {finding.what:{width}}  {finding.seen}'
        if not finding.is_good:
            yield f'  {"":{width}}  {finding.advice}'


def check_robot(names: RobotNames, seconds: float, words: Sequence[str] = ()) -> Checkup:
    """What a robot publishes within some seconds, compared with what is needed.

    words: arguments for ROS, such as remappings.
    """
    with _own_node(words) as node:
        check = RobotCheck(node, names)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=_PERIOD_S)
        return Checkup(list(check.findings()), check.is_simulated)


@contextmanager
def _own_node(words: Sequence[str] = ()) -> Iterator[Node]:
    """The node of this program, while it looks. Raises InputError for a name that is no topic's."""
    rclpy.init(args=list(words))
    node = rclpy.create_node('doctor')
    try:
        yield node
    except InvalidTopicNameException as error:
        raise InputError(f'{error}: expected the name of a topic') from error
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


class RobotCheck:
    """Receives what a robot publishes; `findings` compares it with what is needed."""

    def __init__(self, node: Node, names: RobotNames) -> None:
        self._node = node
        self._names = names
        self._scans: dict[str, list[tuple[LaserScan, float]]] = {}
        self._odometry: list[tuple[Odometry, float]] = []
        self._clock: list[Clock] = []
        self._transforms: dict[tuple[str, str], bool] = {}
        for topic in names.scan_topics:
            self._listen(LaserScan, topic, self._scans.setdefault(topic, []))
        if names.odom_topic:
            self._listen(Odometry, names.odom_topic, self._odometry)
        node.create_subscription(Clock, '/clock', self._clock.append, qos.SENSOR)
        self._localizer: DiagnosticStatus | None = None
        node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        node.create_subscription(TFMessage, 'tf', self._on_moving, _LISTENING)
        node.create_subscription(TFMessage, 'tf_static', self._on_static, qos.STATIC_TRANSFORMS)

    @property
    def is_simulated(self) -> bool:
        """Whether /clock is published."""
        return bool(self._clock)

    def findings(self) -> Iterator[Finding]:
        """All lines, the sensors first."""
        names = self._names
        for topic, scans in self._scans.items():
            yield from self._stream(topic, 'sensor_msgs/msg/LaserScan', scans)
            if scans:
                yield self._laser(scans[-1][0])
        if names.odom_topic:
            yield from self._stream(names.odom_topic, 'nav_msgs/msg/Odometry', self._odometry)
        yield self._frame(names.odom_frame, names.base_frame, 'odometry', 'odom_frame, base_frame')
        heard = [] if names.is_mounted else filter(None, self._scans.values())
        frames = [scans[-1][0].header.frame_id for scans in heard]
        advice = 'publish it on /tf_static (robot_state_publisher)'
        advice += '' if len(names.scan_topics) > 1 else ', or set laser_pose'
        for frame in dict.fromkeys(frames):
            yield self._frame(names.base_frame, frame, 'mount of the laser', advice)
        if len(set(frames)) < len(frames):
            seen = f'{len(frames)} lasers in {", ".join(map(quoted, sorted(set(frames))))}'
            yield Finding('frames of the lasers', False, seen, 'expected one of its own for each')
        yield self._commands()
        yield self._one_map()
        if self._localizer is not None:
            yield _of_localizer(self._localizer)
        yield self._time()

    def _listen(self, kind: type, topic: str, heard: list[tuple[Any, float]]) -> None:
        def hear(message: Any) -> None:
            if len(heard) < _MAX_MESSAGES:
                heard.append((message, time.time()))

        self._node.create_subscription(kind, topic, hear, qos.SENSOR)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.removesuffix(NAME_END).rpartition('/')[2] == 'localizer':
                self._localizer = status

    def _on_moving(self, message: TFMessage) -> None:
        for each in message.transforms:
            self._transforms.setdefault((each.header.frame_id, each.child_frame_id), False)

    def _on_static(self, message: TFMessage) -> None:
        for each in message.transforms:
            self._transforms[each.header.frame_id, each.child_frame_id] = True

    def _stream(self, topic: str, kind: str, heard: list[tuple[Any, float]]) -> Iterator[Finding]:
        """A topic of a sensor: who publishes it, its type and its rate."""
        name = self._node.resolve_topic_name(topic)
        publishers = self._node.get_publishers_info_by_topic(name)
        what = f'topic {name}'
        if not publishers:
            others = self._of_type(kind)
            meant = f'; of its type: {", ".join(others)}' if others else ''
            advice = 'start the driver; other names: --scan-topic, --odom-topic'
            yield Finding(what, False, f'no publisher{meant}', advice)
            return
        wrong = sorted({each.topic_type for each in publishers} - {kind})
        if wrong:
            yield Finding(what, False, f'type {", ".join(wrong)}', f'expected {kind}')
            return
        if not heard:
            yield Finding(what, False, 'a publisher, and no message', 'look at the driver')
            return
        stamps_ns = [messages.stamp_ns(message.header.stamp) for message, _ in heard]
        steps_s = np.diff(stamps_ns) / 1e9
        if steps_s.size and steps_s.min() <= 0.0:
            yield Finding(what, False, 'stamps that do not grow', 'two drivers, or a driver error')
            return
        rate_hz = 1.0 / float(np.median(steps_s)) if steps_s.size else 0.0
        reliability = publishers[0].qos_profile.reliability.name.lower().replace('_', ' ')
        seen = f'{rate_hz:.3g} Hz, {len(publishers)} publisher, {reliability}'
        is_good = rate_hz >= _MIN_RATE_HZ and len(publishers) == 1
        advice = f'expected one publisher of at least {_MIN_RATE_HZ:g} Hz'
        yield Finding(what, is_good, seen, advice)

    def _of_type(self, kind: str) -> list[str]:
        found = self._node.get_topic_names_and_types()
        return [
            name for name, kinds in found if kind in kinds and self._node.count_publishers(name)
        ]

    def _laser(self, scan: LaserScan) -> Finding:
        ranges = np.asarray(scan.ranges, dtype=float)
        hits = np.isfinite(ranges) & (ranges >= scan.range_min) & (ranges <= scan.range_max)
        share = float(hits.mean()) if ranges.size else 0.0
        angle_deg = math.degrees(abs(scan.angle_increment)) * max(ranges.size - 1, 0)
        seen = (
            f'{ranges.size} beams over {angle_deg:.0f} degrees, {scan.range_min:.3g} to '
            f'{scan.range_max:.3g} m, {share:.0%} of them hit'
        )
        advice = 'a covered laser, or a wrong range_min or range_max'
        return Finding('laser', share >= 0.1, seen, advice)

    def _frame(self, parent: str, child: str, what: str, advice: str) -> Finding:
        chain = self._chain(parent, child)
        name = f'transform {parent} -> {child}'
        if chain is None:
            known = sorted({frame for pair in self._transforms for frame in pair})
            seen = f'none; frames: {", ".join(known[:8]) or "none"}'
            return Finding(name, False, seen, f'{what}: {advice}')
        kinds = {self._transforms[pair] for pair in pairwise(chain)}
        return Finding(name, True, 'static' if kinds <= {True} else 'moving')

    def _chain(self, parent: str, child: str) -> list[str] | None:
        """Frames from one down to another; None where they are not connected."""
        parents = {below: above for above, below in self._transforms}
        chain = [child]
        while chain[-1] != parent:
            above = parents.get(chain[-1])
            if above is None or above in chain:
                return None
            chain.append(above)
        return chain[::-1]

    def _commands(self) -> Finding:
        """Who drives the base, in which type, and whether it listens."""
        node = self._node
        name = node.resolve_topic_name(velocity.TOPIC)
        what = f'topic {name}'
        drivers = sorted(set(publisher_names(node, name)))
        base = velocity.base_subscriptions(node)
        by = f'published by {", ".join(drivers)}' if drivers else 'nobody publishes it yet'
        if not base:
            advice = f'start the driver of the base, or remap {velocity.TOPIC} to its topic'
            return Finding(what, not drivers, f'nobody subscribes: cannot be driven; {by}', advice)
        kinds = sorted({info.topic_type for info in base})
        names = ', '.join(sorted(set(map(full_name, base))))
        seen = f'{" and ".join(kinds)} to {names}; {by}'
        if len(kinds) > 1 or kinds[0] not in velocity.KINDS:
            return Finding(what, False, seen, f'expected one of {", ".join(velocity.KINDS)}')
        # Nodes that follow the topic stop share the base on purpose.
        obeying = subscriber_names(node, node.resolve_topic_name(stop_topic.TOPIC))
        others = set(drivers) - set(obeying)
        advice = 'put a multiplexer before the base (twist_mux): a stop cannot hold the others'
        return Finding(what, not others or len(drivers) == 1, seen, advice)

    def _one_map(self) -> Finding:
        names = self._names
        pair = (names.map_frame, names.odom_frame)
        what = f'transform {pair[0]} -> {pair[1]}'
        own = [name for name in self._node.get_node_names() if name == 'localizer']
        if pair in self._transforms and not own:
            advice = 'end it, or set publish_tf:=false: thinmap publishes this one'
            return Finding(what, False, 'another localization publishes it', advice)
        return Finding(
            what, True, 'of the localizer' if own else 'none yet: the localizer makes it'
        )

    def _time(self) -> Finding:
        heard = next(filter(None, self._scans.values()), self._odometry)
        if self._clock:
            return Finding('clock', True, '/clock is published: use_sim_time:=true for all nodes')
        if not heard:
            return Finding('clock', True, 'of the machine')
        message, heard_s = heard[-1]
        delay_s = heard_s - messages.stamp_ns(message.header.stamp) / 1e9
        advice = 'synchronize the clocks of the machines (chrony), or play a bag with --clock'
        seen = f'stamps are {delay_s:.3f} s old'
        return Finding('clock', abs(delay_s) <= _MAX_DELAY_S, seen, advice)


def _of_localizer(status: DiagnosticStatus) -> Finding:
    """What the localizer finds wrong with laser and odometry while the robot drives."""
    scale = next((pair.value for pair in status.values if pair.key == SCALE_KEY), '')
    if scale:
        return Finding('localizer', False, *scale.split(': ', 1))
    return Finding('localizer', status.level < WARN, status.message, 'see the log of the localizer')


TURN_RAD_S = 0.3
_COMMANDED_S = 2.0
_STOPS = 10  # at the end
# A base that turns on after so long has no time-out that helps: at 0.5 m/s it drives a metre.
WATCHED_S = 2.0
# A turn rate is a mean over so long: noise of 0.01 rad is then a fifth of what counts as turning.
_LOOK_S = 0.5
_TURNS_RAD_S = 0.1
# Odometry that takes so many times longer than its stamps is silent.
_PATIENCE = 5.0
_WHAT = 'watchdog of the base'


def try_watchdog(odom_topic: str, base_frame: str) -> Finding:
    """Turn the robot slowly, end the commands without a stop, and look whether it stands.

    Raises InputError where it cannot be tried: no base or odometry, or somebody else drives.
    """
    with _own_node() as node:
        return BaseTrial(node, odom_topic, base_frame).finding()


class BaseTrial:
    """Drives the base of a robot, and receives its odometry, whose stamps are the time."""

    def __init__(self, node: Node, odom_topic: str, base_frame: str) -> None:
        self._node = node
        self._odom_topic = odom_topic
        self._frame = base_frame
        self._yaws: list[tuple[float, float]] = []  # stamp, s, and yaw, rad
        node.create_subscription(Odometry, odom_topic, self._on_odometry, qos.SENSOR)

    def finding(self) -> Finding:
        """Try it; the robot is commanded to stand at the end, whatever happens."""
        if self._turn_rate_after(2.0 * _LOOK_S) > _TURNS_RAD_S:
            raise InputError('the robot turns: expected one that stands')
        kind = self._require_free_base()
        publisher = self._node.create_publisher(kind, velocity.TOPIC, qos.STREAM)

        def command(w: float) -> None:
            twist = messages.twist_msg(0.0, w)
            header = messages.header(self._frame, self._node.get_clock().now().nanoseconds)
            is_stamped = kind is TwistStamped
            publisher.publish(TwistStamped(header=header, twist=twist) if is_stamped else twist)

        try:
            self._await_subscriptions(publisher)
            rate = self._turn_rate_after(_COMMANDED_S, lambda: command(TURN_RAD_S))
            if rate < _TURNS_RAD_S:
                seen = f'told to turn at {TURN_RAD_S:g} rad/s, it does not: not tried'
                return Finding(_WHAT, False, seen, 'emergency stop, motors off, or cmd_vel unused?')
            rate = self._turn_rate_after(WATCHED_S)
        finally:
            for _ in range(_STOPS):
                command(0.0)
                self._spin()
        if rate < _TURNS_RAD_S:
            return Finding(_WHAT, True, f'stands within {WATCHED_S:g} s after the last command')
        seen = f'turns on at {rate:.2f} rad/s {WATCHED_S:g} s after the last command'
        advice = (
            'a program that dies leaves the robot driving: set the time-out of the driver '
            '(ros2_control: cmd_vel_timeout), or put a multiplexer with one before it'
        )
        return Finding(_WHAT, False, seen, advice)

    def _require_free_base(self) -> type:
        """Type of the commands of the base. Raises InputError without one, or with a driver."""
        name = self._node.resolve_topic_name(velocity.TOPIC)
        drivers = publisher_names(self._node, name)
        if drivers:
            raise InputError(f'{name}: published by {", ".join(drivers)}: end it first')
        infos = self._node.get_subscriptions_info_by_topic(name)
        kinds = sorted({info.topic_type for info in infos} & set(velocity.KINDS))
        if not kinds:
            raise InputError(f'{name}: nobody subscribes: expected the driver of the base')
        return velocity.KINDS[kinds[0]]

    def _await_subscriptions(self, publisher: Publisher) -> None:
        """Wait until those who subscribe receive what is published: the base would miss it."""
        end = time.monotonic() + _PATIENCE * _COMMANDED_S
        infos = self._node.get_subscriptions_info_by_topic(publisher.topic_name)
        kinds = [velocity.KINDS.get(info.topic_type) for info in infos]
        expected = kinds.count(publisher.msg_type)
        while publisher.get_subscription_count() < expected and time.monotonic() < end:
            self._spin()

    def _on_odometry(self, message: Odometry) -> None:
        yaw = float(messages.pose_from_msg(message.pose.pose)[2])
        self._yaws.append((messages.stamp_ns(message.header.stamp) / SECOND_NS, yaw))

    def _turn_rate_after(self, seconds: float, work: Callable[[], None] = lambda: None) -> float:
        """Call `work` periodically for so long; turn rate at the end, rad/s, without its sign.

        Raises InputError where the odometry is silent.
        """
        begun_s = self._yaws[-1][0] if self._yaws else None
        end = time.monotonic() + _PATIENCE * seconds
        while begun_s is None or self._yaws[-1][0] - begun_s < seconds:
            work()
            self._spin()
            if begun_s is None and self._yaws:
                begun_s = self._yaws[0][0]
            if time.monotonic() > end:
                raise InputError(f'{self._odom_topic}: silent: expected the odometry of the base')
        now_s, yaw = self._yaws[-1]
        then_s, before = [each for each in self._yaws if each[0] <= now_s - _LOOK_S][-1]
        return abs(se2.wrap(yaw - before)) / (now_s - then_s)

    def _spin(self) -> None:
        end = time.monotonic() + _PERIOD_S
        while (left := end - time.monotonic()) > 0.0:
            rclpy.spin_once(self._node, timeout_sec=left)
