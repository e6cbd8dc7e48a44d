"""What a node tells on /diagnostics once a second: rates, refusals, drops, step times, state."""

import math
import re
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import monotonic, perf_counter

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile

_PERIOD_S = 1.0
_QUIET_S = 10.0
_RECENT_S = 10.0  # what was refused or dropped longer ago is over
_STEPS = 200
_OF_EVERY_NODE = ('/parameter_events', '/rosout', '/diagnostics', '/clock')
# So many kinds of refusal are told apart on a topic: a broken sensor must not fill the memory.
_REASONS = 8
_NUMBER = re.compile(r'-?\b(\d+\.?\d*(e[+-]?\d+)?|inf|nan)\b')
OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR


@dataclass
class _Topic:
    """What came on a topic."""

    heard: int = 0
    told: int = 0
    last_at: float | None = None
    since: float = field(default_factory=monotonic)
    refused: Counter[str] = field(default_factory=Counter)
    last_refusal: str = ''
    refused_at: float = -math.inf


@dataclass
class _Check:
    """What is wrong while its condition finds words for it; logged now and then."""

    level: bytes
    condition: Callable[[], str]
    words: str = ''
    logged_at: float = -_QUIET_S

    def holds(self, node: Node) -> bool:
        self.words = self.condition()
        if not self.words:
            self.logged_at = -_QUIET_S  # what comes back is news
        elif monotonic() - self.logged_at > _QUIET_S:
            self.logged_at = monotonic()
            node.get_logger().warning(self.words)
        return bool(self.words)


class NodeDiagnostics:
    """Counts what happens to a node and publishes it, whatever the node's own time does.

    A level above OK lasts as long as what causes it: refusals and drops until a second has gone by
    without any, a `check` until its condition is no longer true.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._topics: dict[str, _Topic] = {}
        self._steps: dict[str, deque[float]] = {}
        self._drops: Counter[str] = Counter()
        self._dropped_at: dict[str, float] = {}
        self._totals: Counter[str] = Counter()
        self._bad = self._told_bad = 0
        self._state = (OK, 'running')
        self._is_paused = False
        self._values: dict[str, str] = {}
        self._checks: list[_Check] = []
        self._before: list[Callable[[], None]] = []
        self._told_at = monotonic()
        self._topic = node.create_publisher(DiagnosticArray, '/diagnostics', QoSProfile(depth=10))
        # Not in the robot's time: a clock that stands still is a thing to be told.
        node.create_timer(_PERIOD_S, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def expect_topic(self, topic: str) -> None:
        """Name a topic that the node listens to: it is told also while it is silent."""
        self._topics.setdefault(topic, _Topic())

    def message_received(self, topic: str) -> None:
        """Count a message."""
        entry = self._topics.setdefault(topic, _Topic())
        entry.heard += 1
        entry.last_at = monotonic()

    def message_rejected(self, topic: str, reason: str) -> None:
        """Count a message that could not be used, by reason: its words, whatever the numbers."""
        entry = self._topics.setdefault(topic, _Topic())
        kind = _NUMBER.sub('#', reason)
        if kind not in entry.refused and len(entry.refused) >= _REASONS:
            kind = 'other reasons'
        entry.refused[kind] += 1
        entry.last_refusal = reason
        entry.refused_at = monotonic()
        self._bad += 1

    def count_drops(self, cause: str, count: int) -> None:
        """Count messages that were fine and were not used."""
        if count > 0:
            self._drops[cause] += count
            self._dropped_at[cause] = monotonic()
            self._bad += count

    def set_drop_total(self, cause: str, count: int) -> None:
        """Tell a count of drops that somebody else keeps; one that begins anew is counted on."""
        last = self._totals[cause]
        self._totals[cause] = count
        self.count_drops(cause, count - last if count >= last else count)

    def record_step_time(self, step: str, milliseconds: float) -> None:
        """Note how long a step took, ms."""
        self._steps.setdefault(step, deque(maxlen=_STEPS)).append(milliseconds)

    @contextmanager
    def time_step(self, step: str) -> Iterator[None]:
        """Note how long a block takes."""
        started = perf_counter()
        yield
        self.record_step_time(step, 1000.0 * (perf_counter() - started))

    def set_state(self, level: bytes, text: str) -> None:
        """Say what state the node is in."""
        self._state = (level, text)

    def set_paused(self, is_paused: bool) -> None:
        """Say `paused` for as long as that is so, whatever state the node would be in."""
        self._is_paused = is_paused
        self.set_value('paused', is_paused)

    def set_value(self, key: str, value: object) -> None:
        """Set a value that is told until another one takes its place."""
        self._values[key] = str(value)

    def add_check(self, level: bytes, condition: Callable[[], str]) -> None:
        """Look once a second what is wrong: a condition returns words, or '' where all is well."""
        self._checks.append(_Check(level, condition))

    def add_timeout_check(self, topic: str, limit_s: float) -> None:
        """Complain while nothing is heard on a topic."""
        name = self._node.resolve_topic_name(topic)

        def silence() -> str:
            entry = self._topics[topic]
            if entry.last_at is None:
                if monotonic() - entry.since < limit_s:
                    return ''  # nodes have just begun to find each other
                count = self._node.count_publishers(name)
                return f'{topic}: nothing heard yet: {count} publish {name}'
            silent_s = monotonic() - entry.last_at
            return f'{topic}: silent for {silent_s:.0f} s' if silent_s > limit_s else ''

        self.add_check(WARN, silence)

    def add_update_callback(self, work: Callable[[], None]) -> None:
        """Do something once a second, before it is told how things are."""
        self._before.append(work)

    def check_sole_publisher(self, topic: str) -> None:
        """Complain while somebody else publishes a topic that only one node may publish."""
        name = self._node.resolve_topic_name(topic)

        def rivals() -> str:
            if self._node.count_publishers(name) < 2:
                return ''
            nodes = [
                f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                for info in self._node.get_publishers_info_by_topic(name)
            ]
            return (
                f'{len(nodes)} nodes publish {name}: {", ".join(sorted(nodes))}: stop all but one'
            )

        self.add_check(ERROR, rivals)

    def _publish(self) -> None:
        for work in self._before:
            work()
        now = monotonic()
        status = self._status(now)
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._topic.publish(array)
        self._told_at = now
        self._told_bad = self._bad
        for entry in self._topics.values():
            entry.told = entry.heard

    def _status(self, now: float) -> DiagnosticStatus:
        level, message = (OK, 'paused') if self._is_paused else self._state
        checks = [check for check in self._checks if check.holds(self._node)]
        if checks:
            worst = max(checks, key=lambda check: check.level)
            level, message = (worst.level, worst.words) if worst.level > level else (level, message)
        elif level == OK and self._bad > self._told_bad:
            level = WARN
            message = f'{self._bad - self._told_bad} messages refused or dropped: {self._why()}'
        name = self._node.get_fully_qualified_name()
        pairs = [KeyValue(key=key, value=value) for key, value in self._told(now).items()]
        return DiagnosticStatus(
            level=level, name=f'{name.lstrip("/")}: thinmap', message=message, values=pairs
        )

    def _why(self) -> str:
        """Reasons of the last refusals and drops, the newest first; what is over is not told."""
        reasons = [
            (e.refused_at, f'{topic}: {e.last_refusal}') for topic, e in self._topics.items()
        ]
        reasons += [(at, cause) for cause, at in self._dropped_at.items()]
        recent = [reason for reason in reasons if monotonic() - reason[0] <= _RECENT_S]
        return '; '.join(text for _, text in sorted(recent, reverse=True))

    def _connections(self) -> dict[str, str]:
        """How many have been found that hear what the node says, or say what it hears.

        Others may see both of two endpoints a while before these see each other.
        """
        found = {}
        for publisher in list(self._node.publishers):
            if publisher.topic_name not in _OF_EVERY_NODE:
                name = publisher.topic_name.lstrip('/')
                found[f'{name}: listeners'] = str(publisher.get_subscription_count())
        for subscription in list(self._node.subscriptions):
            if subscription.topic_name not in _OF_EVERY_NODE:
                name = subscription.topic_name.lstrip('/')
                found[f'{name}: speakers'] = str(subscription.get_publisher_count())
        return found

    def _told(self, now: float) -> dict[str, str]:
        """All values, in an order that stays."""
        told = dict(self._values)
        told.update(self._connections())
        for topic, entry in self._topics.items():
            told[f'{topic}: heard'] = str(entry.heard)
            told[f'{topic}: rate'] = f'{(entry.heard - entry.told) / (now - self._told_at):.1f} Hz'
            age = 'never' if entry.last_at is None else f'{now - entry.last_at:.1f} s ago'
            told[f'{topic}: last'] = age
            told[f'{topic}: refused'] = str(entry.refused.total())
            for reason, count in entry.refused.items():
                told[f'{topic}: refused: {reason}'] = str(count)
        for cause, count in self._drops.items():
            told[f'dropped: {cause}'] = str(count)
        for step, times in self._steps.items():
            middle, most = np.percentile(times, [50.0, 95.0])
            told[f'{step}: step time'] = (
                f'median {middle:.1f} ms, p95 {most:.1f} ms, max {max(times):.1f} ms'
            )
        return told
