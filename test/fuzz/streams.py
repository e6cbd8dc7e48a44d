"""Streams of messages over time, of a robot that drives through a room, with disturbed parts.

A stream ends with a part that is not disturbed, in which a node has to work again.
"""

import copy
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from sensor_msgs.msg import LaserScan
from support.localized import local_grid, localized
from support.slam_room import ROOM, scan_in

from fuzz.cases import chosen
from thinmap_msgs.msg import LocalGrid, LocalizedScan, ProbabilityGrid, SlamStatus
from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.ros import messages

STEP_NS = 50_000_000
STEPS_PER_SCAN = 4
START_NS = 1000 * SECOND_NS
TOPICS = ('scan', 'odom', 'pose', 'slam_status', 'localized_scan', 'local_grid')
# Longer than any buffer of the past and than the time for which a node waits after a fault.
GOOD_STEPS = 20 * 20
_START = se2.pose(2.0, 2.0, 0.3)
_WINDOW_M = 8.0
_NAMES = ('', 'map', 'odom', 'base_link', '/laser', 'nowhere', 'x' * 100_000, 'a\nb', '\u5730', ' ')
_NUMBERS = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e-30, 1e9, -1e9, 1e30)
Change = Callable[[np.random.Generator, Any], list[Any]]


@dataclass(frozen=True)
class Sent:
    """A message of a topic, sent at a time; is_good: it belongs to the last part of the stream."""

    topic: str
    message: Any
    time_ns: int
    is_good: bool


@dataclass(frozen=True)
class _Disturbance:
    """Messages of a topic are changed from one step to another."""

    name: str
    topic: str
    first: int
    last: int
    change: Change


class Stream:
    """A random stream; description: its disturbances, for what is kept of a failure."""

    def __init__(self, rng: np.random.Generator, topics: tuple[str, ...] = TOPICS) -> None:
        """topics: that a receiver subscribes to; others are not made."""
        self._rng = rng
        self._topics = topics
        self._steps = int(rng.integers(40, 160))
        self._disturbances = [self._disturbance() for _ in range(int(rng.integers(1, 5)))]
        self._grid = OccupancyGrid()
        self._time_ns = START_NS

    @property
    def description(self) -> str:
        """The disturbances, a line each."""
        lines = [f'{d.name} of {d.topic}: steps {d.first} to {d.last}' for d in self._disturbances]
        return '\n'.join(lines) + '\n'

    def _disturbance(self) -> _Disturbance:
        topic = str(chosen(self._rng, self._topics))
        name, make = chosen(self._rng, _KINDS)
        first = int(self._rng.integers(self._steps))
        last = first + int(chosen(self._rng, (0, 0, 5, 20, 60)))
        return _Disturbance(name, topic, first, min(last, self._steps), make(self._rng))

    def messages(self) -> Iterator[Sent]:
        """The stream in order; messages of one scan come after its odometry."""
        rng = self._rng
        T = _START.copy()
        T_odom: Array = np.zeros(3)
        for k in range(self._steps + GOOD_STEPS):
            is_good = k > self._steps
            step = se2.pose(0.012, 0.0, 0.02 * float(np.sin(0.01 * k)) + 0.012)
            T = se2.compose(T, step)
            noise = se2.pose(float(rng.normal(0.0, 0.0005)), 0.0, float(rng.normal(0.0, 0.0005)))
            T_odom = se2.compose(T_odom, se2.compose(step, noise))
            self._time_ns += STEP_NS
            ns = self._time_ns
            made = [('odom', messages.odometry_msg(T_odom, (0.24, 0.2), ('odom', 'base_link'), ns))]
            if k % STEPS_PER_SCAN == 0:
                made += self._of_a_scan(T)
            for topic, message in made:
                if topic not in self._topics:
                    continue
                for changed in self._changed(k, topic, message):
                    yield Sent(topic, changed, ns, is_good)

    def _of_a_scan(self, T: Array) -> list[tuple[str, Any]]:
        ns = self._time_ns
        scan = scan_in(ROOM, T, self._rng, stamp_ns=ns)
        header = messages.header('map', ns)
        made: list[tuple[str, Any]] = [
            ('scan', messages.scan_msg(scan, 'laser', 0.2)),
            ('pose', messages.pose_with_covariance_msg(T, 1e-4 * np.eye(3), 'map', ns)),
            ('slam_status', SlamStatus(header=header, state=SlamStatus.TRACKING)),
            ('localized_scan', localized(scan, T)),
        ]
        if 'local_grid' in self._topics:
            self._grid.add_scan(scan, T)
            window = self._grid.window(float(T[0]), float(T[1]), _WINDOW_M)
            made.append(('local_grid', local_grid(window, T, ns, scan)))
        return made

    def _changed(self, k: int, topic: str, message: Any) -> list[Any]:
        found = [message]
        for disturbance in self._disturbances:
            if disturbance.topic == topic and disturbance.first <= k <= disturbance.last:
                change = disturbance.change
                found = [new for old in found for new in change(self._rng, old)]
        return found


def _parts(message: Any) -> list[Any]:
    """What a message consists of: a scan, a pose, a status, a grid."""
    if isinstance(message, LocalGrid):
        return [message.grid, *_parts(message.localized)]
    if isinstance(message, LocalizedScan):
        return [message, message.scan, message.status]
    return [message]


def _scans(message: Any) -> list[LaserScan]:
    return [part for part in _parts(message) if isinstance(part, LaserScan)]


def _shifted(message: Any, shift_ns: int) -> Any:
    stamp = message.header.stamp
    ns = stamp.sec * SECOND_NS + stamp.nanosec + shift_ns
    message.header.stamp = messages.time_msg(min(max(ns, 0), (2**31 - 1) * SECOND_NS))
    return message


def _shift(rng: np.random.Generator) -> Change:
    size_s = float(chosen(rng, (0.01, 0.3, 1.0, 5.0, 9.0, 11.0, 100.0, 1e5, 1e9)))
    shift_ns = int(size_s * SECOND_NS) * int(chosen(rng, (1, -1)))
    return lambda _, message: [_shifted(message, shift_ns)]


def _jitter(rng: np.random.Generator) -> Change:
    size_ns = int(chosen(rng, (1, 10**6, 10**9)))
    return lambda rng, message: [_shifted(message, int(rng.integers(-size_ns, size_ns + 1)))]


def _constant_stamp(rng: np.random.Generator) -> Change:
    sec = int(chosen(rng, (0, 0, -1, 1, 1000, 2**31 - 1, -(2**31))))
    nanosec = int(chosen(rng, (0, 0, 1, 10**9, 2**32 - 1)))

    def change(_: np.random.Generator, message: Any) -> list[Any]:
        message.header.stamp.sec = sec
        message.header.stamp.nanosec = nanosec
        return [message]

    return change


def _same_stamp(_: np.random.Generator) -> Change:
    first: list[Any] = []

    def change(_: np.random.Generator, message: Any) -> list[Any]:
        first.append(copy.copy(message.header.stamp))
        message.header.stamp = first[0]
        return [message]

    return change


def _frozen(_: np.random.Generator) -> Change:
    """The content of the first message again and again, with new stamps."""
    first: list[Any] = []

    def change(_: np.random.Generator, message: Any) -> list[Any]:
        first.append(message)
        frozen = copy.deepcopy(first[0])
        frozen.header.stamp = message.header.stamp
        return [frozen]

    return change


def _frames(rng: np.random.Generator) -> Change:
    name = str(chosen(rng, _NAMES))

    def change(rng: np.random.Generator, message: Any) -> list[Any]:
        message.header.frame_id = name if rng.random() < 0.8 else str(chosen(rng, _NAMES))
        if isinstance(message, Odometry):
            message.child_frame_id = str(chosen(rng, ('base_link', name)))
        return [message]

    return change


def _flood(rng: np.random.Generator) -> Change:
    count = int(chosen(rng, (2, 10, 100)))
    spread_ns = int(chosen(rng, (0, 0, 1, 1000)))

    def change(_: np.random.Generator, message: Any) -> list[Any]:
        return [_shifted(copy.deepcopy(message), spread_ns * i) for i in range(count)]

    return change


def _late(_: np.random.Generator) -> Change:
    """Messages in another order: each comes after some later ones."""
    kept: list[Any] = []

    def change(rng: np.random.Generator, message: Any) -> list[Any]:
        kept.append(message)
        return [kept.pop(int(rng.integers(len(kept))))] if len(kept) > 5 else []

    return change


def _lost(_: np.random.Generator) -> Change:
    return lambda rng, message: [] if rng.random() < 0.7 else [message]


def _numbers(rng: np.random.Generator) -> Change:
    value = float(chosen(rng, _NUMBERS))
    share = float(chosen(rng, (0.01, 0.5, 1.0)))

    def change(rng: np.random.Generator, message: Any) -> list[Any]:
        part = chosen(rng, _parts(message))
        if isinstance(part, LaserScan):
            ranges = np.array(part.ranges, dtype=np.float32)
            ranges[rng.random(ranges.size) < share] = value
            part.ranges = array('f', ranges.tolist())
        elif isinstance(part, ProbabilityGrid):
            part.info.resolution = value if abs(value) < 1e30 else 0.0
        elif isinstance(part, SlamStatus):
            part.state = int(rng.integers(256))
        else:
            pose = part.pose.pose
            setattr(pose.position, str(rng.choice(['x', 'y', 'z'])), value)
            if rng.random() < 0.3:
                pose.orientation.w = value
            part.pose.covariance[int(rng.integers(36))] = value
        return [message]

    return change


def _sizes(rng: np.random.Generator) -> Change:
    count = int(chosen(rng, (0, 1, 2, 7, 10_000)))
    side = int(chosen(rng, (0, 1, 3000, 2**32 - 1)))

    def change(_: np.random.Generator, message: Any) -> list[Any]:
        for part in _parts(message):
            if isinstance(part, LaserScan):
                ranges = np.resize(np.array(part.ranges, dtype=np.float32), count)
                part.ranges = array('f', ranges.tolist())
            elif isinstance(part, ProbabilityGrid):
                part.info.width = side
        return [message]

    return change


def _sparse(rng: np.random.Generator) -> Change:
    """One beam of several: no two returns side by side, or fewer beams than a laser needs."""
    every = int(chosen(rng, (2, 3, 20, 40)))
    value = float(chosen(rng, (np.inf, np.nan, 0.0)))

    def change(_: np.random.Generator, message: Any) -> list[Any]:
        for scan in _scans(message):
            ranges = np.full(len(scan.ranges), value, dtype=np.float32)
            ranges[::every] = scan.ranges[::every]
            scan.ranges = array('f', ranges.tolist())
        return [message]

    return change


def _jump(rng: np.random.Generator) -> Change:
    """Poses elsewhere."""
    size_m = float(chosen(rng, (0.2, 1.0, 5.0, 100.0, 1e5)))
    jump = rng.uniform(-size_m, size_m, 2)

    def change(_: np.random.Generator, message: Any) -> list[Any]:
        for part in _parts(message):
            if hasattr(part, 'pose'):
                part.pose.pose.position.x += float(jump[0])
                part.pose.pose.position.y += float(jump[1])
        return [message]

    return change


def _turned_laser(rng: np.random.Generator) -> Change:
    """A laser that is turned on its mount, or mirrored."""
    beams = int(chosen(rng, (3, 12, 30, 90)))
    is_mirrored = bool(rng.random() < 0.3)

    def change(_: np.random.Generator, message: Any) -> list[Any]:
        for scan in _scans(message):
            ranges = np.array(scan.ranges, dtype=np.float32)
            ranges = ranges[::-1] if is_mirrored else np.roll(ranges, beams)
            scan.ranges = array('f', ranges.tolist())
        if isinstance(message, Odometry) and is_mirrored:
            message.pose.pose.orientation.z *= -1.0
        return [message]

    return change


def _angles(rng: np.random.Generator) -> Change:
    """Angles of a scan that do not fit its beams, or are in degrees."""
    name = str(chosen(rng, ('angle_min', 'angle_max', 'angle_increment')))
    factor = float(chosen(rng, (-1.0, 0.0, 0.5, 2.0, 57.3, 1e30, np.nan)))

    def change(_: np.random.Generator, message: Any) -> list[Any]:
        for scan in _scans(message):
            setattr(scan, name, max(min(factor * getattr(scan, name), 1e30), -1e30))
        return [message]

    return change


def _sweep(rng: np.random.Generator) -> Change:
    """A driver that states the times of its beams, rightly or not."""
    period_s = float(chosen(rng, (0.2, -0.2, 0.05, 5.0, 1e9, np.nan, np.inf)))
    scan_time_s = float(chosen(rng, (0.0, 0.2, -1.0, np.nan)))

    def change(_: np.random.Generator, message: Any) -> list[Any]:
        for scan in _scans(message):
            scan.time_increment = period_s / 360.0
            scan.scan_time = scan_time_s
        return [message]

    return change


def _restarted(rng: np.random.Generator) -> Change:
    """An odometry that begins at 0 again, wherever it was, with another heading."""
    turn = float(chosen(rng, (0.0, 0.4, 1.6, 3.1)))
    first: list[Array] = []

    def change(_: np.random.Generator, message: Any) -> list[Any]:
        if isinstance(message, Odometry):
            T = messages.pose_from_msg(message.pose.pose)
            first.append(T)
            moved = se2.compose(se2.pose(0.0, 0.0, turn), se2.between(first[0], T))
            message.pose.pose = messages.pose_msg(moved)
        return [message]

    return change


_KINDS = (
    ('times of beams', _sweep),
    ('a restarted odometry', _restarted),
    ('shifted stamps', _shift),
    ('shifted stamps', _shift),
    ('jitter of stamps', _jitter),
    ('constant stamps', _constant_stamp),
    ('repeated stamps', _same_stamp),
    ('frozen content', _frozen),
    ('strange frames', _frames),
    ('a flood', _flood),
    ('another order', _late),
    ('lost messages', _lost),
    ('strange numbers', _numbers),
    ('wrong sizes', _sizes),
    ('sparse beams', _sparse),
    ('jumps', _jump),
    ('a turned laser', _turned_laser),
    ('contradictory angles', _angles),
)
