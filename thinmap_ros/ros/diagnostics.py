"""Diagnostics of a node on /diagnostics once a second: rates, drops, step times, state."""

import math
import re
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import monotonic, perf_counter
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from thinmap_ros.core.errors import counted, one_line_reason
from thinmap_ros.ros import qos
from thinmap_ros.ros.time_jumps import STEADY

_PERIOD_S = 1.0
NAME_END = ': thinmap'  # of the name of a status, after that of its node
# For which a failed step is reported, unless another fails: five times what is published.
_FAILED_S = 5.0
_MAX_TRACEBACKS = 20  # in the log of a node, each of another place in the code
_TOPICS_OF_EVERY_NODE = ('/parameter_events', '/rosout', '/diagnostics', '/clock')
_NUMBER = re.compile(r'-?\b(\d+\.?\d*(e[+-]?\d+)?|inf|nan)\b')
_RECENT_S = 10.0  # older reasons are not reported
_STEPS = 200  # whose durations are kept
_MAX_REASONS = 8  # that are counted apart: a broken sensor must not fill the memory
SCALE_KEY = 'odometry scale'  # of a value of the localizer: what is wrong, '' for nothing
OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR


@dataclass
class _Topic:
    """Messages of a topic; times are of the monotonic clock, s."""

    received: int = 0
    published: int = 0  # value of `received` in the last diagnostics
    last_s: float | None = None
    since_s: float = field(default_factory=monotonic)
    rejected: Counter[str] = field(default_factory=Counter)
    last_reason: str = ''
    rejected_s: float = -math.inf

    def reject(self, reason: str) -> None:
        """Count a rejection by its reason, whatever the numbers in it."""
        kind = _NUMBER.sub('#', reason)
        if kind not in self.rejected and len(self.rejected) >= _MAX_REASONS:
            kind = 'other reasons'
        self.rejected[kind] += 1
        self.last_reason = reason
        self.rejected_s = monotonic()

    def values(self, now_s: float, period_s: float) -> dict[str, str]:
        """Values by the key after the name of the topic."""
        last = 'never' if self.last_s is None else f'{now_s - self.last_s:.1f} s ago'
        values = {
            'received': str(self.received),
            'rate': f'{(self.received - self.published) / period_s:.1f} Hz',
            'last': last,
            'rejected': str(self.rejected.total()),
        }
        return values | {f'rejected: {why}': str(count) for why, count in self.rejected.items()}


@dataclass
class _Drops:
    """Messages dropped for one cause; total: of a counter that is kept elsewhere."""

    count: int = 0
    total: int = 0
    last_s: float = -math.inf


class MessageStatistics:
    """Counts the messages of each topic that a node received, rejected and dropped."""

    def __init__(self) -> None:
        self._topics: dict[str, _Topic] = {}
        self._drops: dict[str, _Drops] = {}
        self._faults = 0
        self._published_faults = 0
        self._published_s = monotonic()

    def expect_topic(self, name: str) -> _Topic:
        """The counters of a topic, which is reported before its first message, too."""
        return self._topics.setdefault(name, _Topic())

    def message_received(self, name: str) -> None:
        """Count a message."""
        topic = self.expect_topic(name)
        topic.received += 1
        topic.last_s = monotonic()

    def message_rejected(self, name: str, reason: str) -> None:
        """Count a message that could not be used, by reason."""
        self.expect_topic(name).reject(reason)
        self._faults += 1

    def count_drops(self, cause: str, count: int) -> None:
        """Count valid messages that were not used."""
        if count > 0:
            drops = self._drops.setdefault(cause, _Drops())
            drops.count += count
            drops.last_s = monotonic()
            self._faults += count

    def set_drop_total(self, cause: str, total: int) -> None:
        """Count the drops since the last total; a smaller one is of a counter that was reset."""
        drops = self._drops.setdefault(cause, _Drops())
        last = drops.total
        drops.total = total
        self.count_drops(cause, total - last if total >= last else total)

    def new_faults(self) -> str:
        """Rejections and drops since the last diagnostics, in words; '' for none."""
        count = self._faults - self._published_faults
        if not count:
            return ''
        return f'{counted(count, "message")} rejected or dropped: {self._recent_reasons()}'

    def values(self, now_s: float) -> dict[str, str]:
        """All counts, in a fixed order."""
        period_s = now_s - self._published_s
        values = {
            f'{name}: {key}': value
            for name, topic in self._topics.items()
            for key, value in topic.values(now_s, period_s).items()
        }
        dropped = {cause: drops.count for cause, drops in self._drops.items() if drops.count}
        return values | {f'dropped: {cause}': str(count) for cause, count in dropped.items()}

    def mark_published(self, now_s: float) -> None:
        """Rates and new faults are counted from now on."""
        self._published_s = now_s
        self._published_faults = self._faults
        for topic in self._topics.values():
            topic.published = topic.received

    def _recent_reasons(self) -> str:
        """Reasons of the last rejections and drops; older ones are not reported."""
        reasons = [(t.rejected_s, f'{name}: {t.last_reason}') for name, t in self._topics.items()]
        reasons += [(drops.last_s, cause) for cause, drops in self._drops.items()]
        recent = [reason for reason in reasons if monotonic() - reason[0] <= _RECENT_S]
        return '; '.join(text for _, text in sorted(recent, reverse=True))


class _StepFailures:
    """Steps that ended in an error that nobody expects, and the last of these errors."""

    def __init__(self) -> None:
        self.count = 0
        self.last = ''
        self._last_s = -math.inf
        self._places: set[str] = set()

    def add(self, step: str, error: Exception) -> str:
        """Count a step; returns the traceback where the error comes from another place."""
        self.count += 1
        self._last_s = monotonic()
        self.last = f'{step} failed: {type(error).__name__}: {one_line_reason(error)}'
        place = str(traceback.extract_tb(error.__traceback__)[-1:])
        if place in self._places or len(self._places) >= _MAX_TRACEBACKS:
            return ''
        self._places.add(place)
        return ''.join(traceback.format_exception(error))

    def fault(self) -> str:
        """What failed within the last seconds; '' if nothing did."""
        return self.last if monotonic() - self._last_s < _FAILED_S else ''


ENDED = 'ended'  # the last message of a node


@dataclass
class _Check:
    """A condition that returns what is wrong, '' for nothing; logged now and then."""

    level: bytes
    condition: Callable[[], str]
    fault: str = ''
    log_period_s: float = 10.0
    logged_s: float = -math.inf

    def fails(self, node: Node) -> bool:
        self.fault = self.condition()
        if not self.fault:
            self.logged_s = -math.inf  # a fault that returns is logged at once
        elif monotonic() - self.logged_s > self.log_period_s:
            self.logged_s = monotonic()
            node.get_logger().warning(self.fault)
        return bool(self.fault)


class NodeDiagnostics(MessageStatistics):
    """Publishes the state of a node once a second of the machine, whatever the node's clock does.

    A level above OK lasts as long as its cause: rejections and drops until a second without any, a
    check until its condition returns '', a failed step for 5 s.
    """

    def __init__(self, node: Node) -> None:
        super().__init__()
        self._node = node
        self._step_times_ms: dict[str, deque[float]] = {}
        self._state = (OK, 'running')
        self._is_paused = False
        self._values: dict[str, str] = {}
        self._failures = _StepFailures()
        self._checks = [_Check(ERROR, self._failures.fault)]
        self._update_callbacks: list[Callable[[], None]] = []
        self._topic = node.create_publisher(DiagnosticArray, '/diagnostics', QoSProfile(depth=10))
        # Not in the node's time: a clock that stands still is reported, too.
        node.create_timer(_PERIOD_S, self._publish, clock=STEADY)

    def record_step_time(self, step: str, milliseconds: float) -> None:
        """Record the duration of a step, ms."""
        self._step_times_ms.setdefault(step, deque(maxlen=_STEPS)).append(milliseconds)

    def step_failed(self, step: str, error: Exception) -> None:
        """Report an error that nobody expects: ERROR, its traceback in the log, a count."""
        trace = self._failures.add(step, error)
        self.set_value('failed steps', self._failures.count)
        if trace:
            self._node.get_logger().error(f'{self._failures.last}\n{trace}')

    @contextmanager
    def time_step(self, step: str) -> Iterator[None]:
        """Record the duration of a block."""
        started = perf_counter()
        yield
        self.record_step_time(step, 1000.0 * (perf_counter() - started))

    def set_state(self, level: bytes, text: str) -> None:
        """Set level and message that are published while no check fails."""
        self._state = (level, text)

    def end(self) -> None:
        """Publish that the node ends in order, so that nobody waits for more."""
        self.set_state(OK, ENDED)
        self._publish()

    def set_paused(self, is_paused: bool) -> None:
        """Publish `paused` instead of the state while that is so."""
        self._is_paused = is_paused
        self.set_value('paused', is_paused)

    def set_value(self, key: str, value: object) -> None:
        """Set a value; it is published until it is replaced."""
        self._values[key] = str(value)

    def add_check(self, level: bytes, condition: Callable[[], str]) -> None:
        """Check a condition once a second: it returns what is wrong, '' for nothing."""
        self._checks.append(_Check(level, condition))

    def add_timeout_check(self, topic: str, limit_s: float) -> None:
        """Warn while a topic is silent for longer than a limit, s."""
        name = self._node.resolve_topic_name(topic)

        def silence() -> str:
            counters = self.expect_topic(topic)
            if counters.last_s is None:
                if monotonic() - counters.since_s < limit_s:
                    return ''  # discovery of other nodes may not be complete
                count = self._node.count_publishers(name)
                return f'{topic}: no message yet: {count} publishers of {name}'
            silent_s = monotonic() - counters.last_s
            return f'{topic}: silent for {silent_s:.0f} s' if silent_s > limit_s else ''

        self.add_check(WARN, silence)

    def add_update_callback(self, work: Callable[[], None]) -> None:
        """Call `work` once a second, before the diagnostics are published."""
        self._update_callbacks.append(work)

    @property
    def error(self) -> str:
        """The first failed check of level ERROR, by the last diagnostics; '' for none."""
        return next((each.fault for each in self._checks if each.level == ERROR and each.fault), '')

    def check_sole_publisher(
        self,
        topic: str,
        level: bytes = ERROR,
        is_heard: Callable[[], bool] = lambda: True,
        partners: str | None = None,
    ) -> None:
        """Report at a level that several nodes publish a topic, an output or an input.

        is_heard: whether several do so now; a node that was killed is still known for a while.
        partners: topic whose publishers may publish this one, too.
        """
        name = self._node.resolve_topic_name(topic)
        own = self._node.get_fully_qualified_name()

        def allowed() -> set[str]:
            if partners is None:
                return set()
            return {*publisher_names(self._node, self._node.resolve_topic_name(partners))} - {own}

        def rivals() -> str:
            if self._node.count_publishers(name) < 2 or not is_heard():
                return ''
            others = allowed()
            nodes = [each for each in publisher_names(self._node, name) if each not in others]
            if len(nodes) < 2:
                return ''
            return f'{len(nodes)} nodes publish {name}: {", ".join(nodes)}: stop all but one'

        self.add_check(level, rivals)

    def _publish(self) -> None:
        for work in self._update_callbacks:
            work()
        now_s = monotonic()
        array = DiagnosticArray(status=[self._status(now_s)])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._topic.publish(array)
        self.mark_published(now_s)

    def _status(self, now_s: float) -> DiagnosticStatus:
        level, message = self._level_and_message()
        values = self._values | self._connections() | self.values(now_s)
        values |= self._step_times()
        name = self._node.get_fully_qualified_name()
        return DiagnosticStatus(
            level=level,
            name=f'{name.lstrip("/")}{NAME_END}',
            message=message,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )

    def _step_times(self) -> dict[str, str]:
        """Median, 95th percentile and maximum of the last steps of each kind."""
        values = {}
        for step, times in self._step_times_ms.items():
            median, p95 = np.percentile(times, [50.0, 95.0])
            text = f'median {median:.1f} ms, p95 {p95:.1f} ms, max {max(times):.1f} ms'
            values[f'{step}: step time'] = text
        return values

    def _level_and_message(self) -> tuple[bytes, str]:
        level, message = (OK, 'paused') if self._is_paused else self._state
        failed = [check for check in self._checks if check.fails(self._node)]
        if failed:
            worst = max(failed, key=lambda check: check.level)
            return (worst.level, worst.fault) if worst.level > level else (level, message)
        faults = self.new_faults()
        return (WARN, faults) if faults and level == OK else (level, message)

    def _connections(self) -> dict[str, str]:
        """Number of subscribers of each published topic, and of publishers of each subscribed one.

        Other nodes may discover both endpoints before these discover each other.
        """
        node = self._node
        own: list[tuple[Iterable[Any], str, Callable[[Node, Any], str]]] = [
            (node.publishers, 'subscribers', _subscribers),
            (node.subscriptions, 'publishers', _publishers),
        ]
        return {
            f'{each.topic_name.lstrip("/")}: {others}': described(node, each)
            for endpoints, others, described in own
            for each in list(endpoints)
            if each.topic_name not in _TOPICS_OF_EVERY_NODE
        }


def publisher_names(node: Node, topic: str) -> list[str]:
    """Full names of the nodes that publish a topic, sorted, one for each publisher."""
    return _full_names(node.get_publishers_info_by_topic(topic))


def subscriber_names(node: Node, topic: str) -> list[str]:
    """Full names of the nodes that subscribe to a topic, sorted, one for each subscription."""
    return _full_names(node.get_subscriptions_info_by_topic(topic))


def _full_names(infos: list[TopicEndpointInfo]) -> list[str]:
    return sorted(map(full_name, infos))


def full_name(info: TopicEndpointInfo) -> str:
    """Full name of the node of a publisher or subscription."""
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'


def _subscribers(node: Node, publisher: Publisher) -> str:
    """Number of matched subscriptions, and why others of the topic do not match."""
    count = publisher.get_subscription_count()
    if node.count_subscribers(publisher.topic_name) == count:
        return str(count)
    others = node.get_subscriptions_info_by_topic(publisher.topic_name)
    mismatches = [qos.mismatch(publisher.qos_profile, other.qos_profile) for other in others]
    return _count_with_mismatches(count, mismatches)


def _publishers(node: Node, subscription: Subscription) -> str:
    """Number of matched publishers, and why others of the topic do not match."""
    count = subscription.get_publisher_count()
    if node.count_publishers(subscription.topic_name) == count:
        return str(count)
    others = node.get_publishers_info_by_topic(subscription.topic_name)
    mismatches = [qos.mismatch(other.qos_profile, subscription.qos_profile) for other in others]
    return _count_with_mismatches(count, mismatches)


def _count_with_mismatches(count: int, mismatches: list[str]) -> str:
    """A count of matched endpoints; mismatches: one text for each endpoint, '' where it matches."""
    faults = [text for text in mismatches if text]
    if not faults:
        return str(count)
    kinds = '; '.join(dict.fromkeys(faults))
    return f'{count} (and {len(faults)} with incompatible QoS: {kinds})'
