"""Guarded subscriptions: messages are processed while the node is active.

Invalid messages, and those whose processing fails, are counted, logged and dropped; messages lost
on the way are counted.
"""

from collections import deque
from collections.abc import Callable
from time import monotonic
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.event_handler import QoSRequestedIncompatibleQoSInfo, SubscriptionEventCallbacks
from rclpy.qos import (
    DurabilityPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
)
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from sensor_msgs.msg import LaserScan

from thinmap_msgs.msg import LocalizedScan, SlamStatus, TeamClaim
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.ros.diagnostics import WARN
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.sole_source import SourceByFrame
from thinmap_ros.ros.time_jumps import STEADY

WARN_PERIOD_S = 5.0  # between two warnings of the same kind
_TIMEOUT_S = 3.0
_SCANS = (LaserScan, LocalizedScan)
# Data of one sensor: those of two mixed are of none. Positions of two odometries jump.
_SOLE_SOURCE = (*_SCANS, Odometry, SlamStatus)
# Stamps by different clocks: losses are not counted.
_MANY_SOURCES = (TeamClaim, DiagnosticArray)
_MAX_SKIPPED = 50  # larger steps of the number may be those to another publisher
_MAX_GAP_NS = 5_000_000_000  # longer gaps are pauses of the sensor, no losses


def subscribe_guarded(
    node: ThinmapNode,
    kind: type,
    topic: str,
    process: Callable[[Any], None],
    profile: QoSProfile,
) -> None:
    """Subscribe to a topic.

    A message for which `process` raises InputError is dropped with a throttled warning; with any
    other error it is dropped, too, and a step of the node has failed. Where a publisher offers less
    than the profile requests (best effort, volatile), less is requested.
    """
    _GuardedSubscription(node, kind, topic, process, profile)


# Type, topic, what processes a message, and quality of service.
Topic = tuple[type, str, Callable[[Any], None], QoSProfile]


def subscribe_all(node: ThinmapNode, *topics: Topic) -> None:
    """Subscribe to several topics, each as `subscribe_guarded`."""
    for topic in topics:
        subscribe_guarded(node, *topic)


class _GuardedSubscription:
    """A subscription with the state that its checks need."""

    def __init__(
        self,
        node: ThinmapNode,
        kind: type,
        topic: str,
        process: Callable[[Any], None],
        profile: QoSProfile,
    ) -> None:
        self._node = node
        self._topic = topic
        self._process = process
        self._is_scan = kind in _SCANS
        self._is_latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        self._counts_losses = not self._is_latched and kind not in _MANY_SOURCES
        self._latched_message: Any = None
        self._logged_s = -WARN_PERIOD_S
        self._last_ns = 0
        self._time_jumps = 0
        is_sole = kind in _SOLE_SOURCE
        self._losses = MessageLossCounter(is_sole)
        self._sources = SourceByFrame(node, topic) if is_sole else None
        node.diagnostics.expect_topic(topic)
        AdaptiveSubscription(node, kind, topic, self._on_message, profile)
        if is_sole:
            node.diagnostics.check_sole_publisher(topic, WARN)
        if self._is_scan:
            node.diagnostics.add_timeout_check(topic, _TIMEOUT_S)
        if self._is_latched:
            node.add_activation_callback(self._process_latched)

    def _on_message(self, message: Any, info: dict[str, Any]) -> None:
        node = self._node
        node.diagnostics.message_received(self._topic)
        if self._sources and not self._sources.accepts(message, info):
            node.diagnostics.count_drops(f'{self._topic}: from another publisher', 1)
            return
        last_ns = self._last_ns
        self._last_ns = _stamp_ns(message)
        if self._counts_losses:
            self._count_losses(info.get('publication_sequence_number'))
        node.handle_time_jump()
        if self._is_outdated(last_ns):
            node.diagnostics.count_drops(f'{self._topic}: from before the clock jumped back', 1)
        elif not node.is_active:
            self._latched_message = message if self._is_latched else None
        elif not (self._is_scan and node.is_paused):
            self._guarded(message)

    def _is_outdated(self, last_ns: int) -> bool:
        """Whether a message was queued before the clock jumped back: it continues that stream.

        The first one that does not continue it starts the stream of the new time.
        """
        node = self._node
        if self._time_jumps == node.time_jumps.count:
            return False
        if node.time_jumps.is_before(last_ns) and node.time_jumps.is_before(self._last_ns):
            return True
        self._time_jumps = node.time_jumps.count
        return False

    def _count_losses(self, number: int | None) -> None:
        lost, missing = self._losses.record(self._last_ns, number)
        self._node.diagnostics.count_drops(
            f'{self._topic}: lost in transport or in a full queue', lost
        )
        if self._is_scan:
            self._node.diagnostics.count_drops(f'{self._topic}: gaps between the stamps', missing)

    def _guarded(self, message: Any) -> None:
        try:
            self._process(message)
        except InputError as error:
            self._node.diagnostics.message_rejected(self._topic, str(error))
            if monotonic() - self._logged_s >= WARN_PERIOD_S:
                self._logged_s = monotonic()
                self._node.get_logger().warning(f'{self._topic}: {error}')
        except Exception as error:
            self._node.diagnostics.count_drops(f'{self._topic}: step failed', 1)
            self._node.step_failed(f'{self._topic} at {_stamp_ns(message)} ns', error)

    def _process_latched(self) -> None:
        message = self._latched_message
        self._latched_message = None
        if message is not None:
            self._guarded(message)


class AdaptiveSubscription:
    """A subscription that is replaced by one with lower requests where a publisher offers less.

    The odometry of many robots is best effort, and a map may be volatile: with the requests of the
    profile no message would arrive. Lower requests fit all publishers.
    """

    def __init__(
        self,
        node: ThinmapNode,
        kind: type,
        topic: str,
        on_message: Callable[[Any, dict[str, Any]], None],
        profile: QoSProfile,
        raw: bool = False,
    ) -> None:
        """raw: messages are given as they were sent, serialized."""
        self._raw = raw
        self._node = node
        self._kind = kind
        self._topic = topic
        self._on_message = on_message
        self._profile = profile
        self._timer: Timer | None = None
        self._subscription = self._subscribe()

    def _subscribe(self) -> Subscription:
        events = SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible_qos)
        return self._node.create_subscription(
            self._kind,
            self._topic,
            self._on_message,
            self._profile,
            event_callbacks=events,
            raw=self._raw,
        )

    def _on_incompatible_qos(self, event: QoSRequestedIncompatibleQoSInfo) -> None:
        kind = QoSPolicyKind(event.last_policy_kind)
        profile = lowered(self._profile, kind)
        if profile is None:
            policy = qos_policy_name_from_kind(kind)
            self._node.diagnostics.set_value(
                f'{self._topic}: incompatible QoS', f'{event.total_count} publishers: {policy}'
            )
        elif self._timer is None:
            self._profile = profile
            # Not now: the event belongs to the subscription that is destroyed.
            self._timer = self._node.create_timer(0.0, self._replace, clock=STEADY)

    def _replace(self) -> None:
        self._node.destroy_timer(self._timer)
        self._timer = None
        self._node.destroy_subscription(self._subscription)
        self._subscription = self._subscribe()
        reliability = self._profile.reliability.name.lower()
        durability = self._profile.durability.name.lower()
        text = f'{reliability}, {durability}, as a publisher offers no more'
        self._node.diagnostics.set_value(f'{self._topic}: subscribed', text)
        self._node.get_logger().info(f'{self._topic}: subscribed {text}')


def lowered(profile: QoSProfile, kind: QoSPolicyKind) -> QoSProfile | None:
    """Profile that requests less of an incompatible policy; None where it cannot request less."""
    requests = {'reliability': profile.reliability, 'durability': profile.durability}
    if kind == QoSPolicyKind.RELIABILITY:
        requests['reliability'] = ReliabilityPolicy.BEST_EFFORT
    elif kind == QoSPolicyKind.DURABILITY:
        requests['durability'] = DurabilityPolicy.VOLATILE
    else:
        return None
    return QoSProfile(depth=profile.depth, history=profile.history, **requests)


class MessageLossCounter:
    """Counts the messages of a stream that were lost in transport or never sent.

    It compares the sequence numbers of the publisher with the evenly spaced stamps. Either alone is
    not enough: two publishers have independent numbers, and a silent sensor has lost nothing. A few
    numbers that a sole publisher skips are losses, whatever the stamps: they may repeat or go back.
    """

    def __init__(self, is_sole: bool = False) -> None:
        """is_sole: whether the stream is of one publisher at a time."""
        self._is_sole = is_sole
        self._last_ns = 0
        self._last_number = 0
        self._steps_ns: deque[int] = deque(maxlen=50)

    def record(self, stamp_ns: int, number: int | None) -> tuple[int, int]:
        """Record a message with its sequence number (None: the middleware has none).

        Returns how many messages between it and the last one were lost in transport, and how many
        more are missing: never sent, or lost without sequence numbers.
        """
        step_ns = stamp_ns - self._last_ns
        self._last_ns = stamp_ns
        skipped = (number or 0) - self._last_number - 1 if self._last_number else 0
        self._last_number = number or 0
        spaces = 0
        if step_ns > 0:
            spaces = round(step_ns / min(self._steps_ns, default=step_ns)) - 1
            self._steps_ns.append(step_ns)
        is_near = self._is_sole and skipped <= _MAX_SKIPPED
        lost = max(skipped, 0) if is_near else min(max(skipped, 0), max(spaces, 0))
        return lost, spaces - lost if spaces > lost and step_ns < _MAX_GAP_NS else 0


def _stamp_ns(message: Any) -> int:
    """Stamp of a message, unchecked."""
    return int(SECOND_NS * message.header.stamp.sec + message.header.stamp.nanosec)
