"""Plays a bag and publishes /clock."""

import contextlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

from rclpy.duration import Duration
from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock as ClockMsg
from std_srvs.srv import SetBool, Trigger

from thinmap_ros.core import errors
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError, InputError, counted
from thinmap_ros.logs.playback import Playback, is_scan
from thinmap_ros.logs.readers.bag import SCAN, Bag
from thinmap_ros.logs.storage import RawMessage
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.diagnostics import OK, WARN, NodeDiagnostics
from thinmap_ros.ros.localized_scan import NONE, TIMEOUT_DESCRIPTION, TIMEOUT_S, TOPICS, Lockstep
from thinmap_ros.ros.messages import message_class
from thinmap_ros.ros.services import offer
from thinmap_ros.ros.time_jumps import STEADY

_TICK_S = 0.002  # between two looks for messages that are due
_CLOCK_PERIOD_S = 0.02  # between two messages on /clock, at most
_SETTLE_S = 0.5  # from the subscription to the scans to the first message
_ACKNOWLEDGE_S = 1.0  # for the acknowledgement of the last messages, at most


@dataclass(frozen=True)
class BagPlayerConfig(Config):
    """Parameters of the player."""

    bag: str = parameter('', 'rosbag2 folder or MCAP file.')
    topics: str = parameter('', 'Topics to play, separated by commas. Empty: all.')
    prefix: str = parameter('', 'Prefix of each topic: robot1 makes /scan /robot1/scan.')
    rate: float = parameter(1.0, 'Seconds of the bag per second.', low=0.01, high=1000.0)
    start_offset_s: float = parameter(
        0.0, 'Time into the bag at which playback starts (s).', low=0.0
    )
    loop: bool = parameter(False, 'Start again at the end of the bag.')
    start_paused: bool = parameter(False, 'Start paused, until ~/pause or ~/step.')
    wait_for_subscribers: int = parameter(
        1,
        'Playback starts when every scan topic (or, without one, any topic) has this many '
        'subscribers.',
        low=0,
        high=100,
    )
    lockstep: str = parameter(
        NONE,
        'Topic whose message for each scan is awaited, so that nothing is lost at high rates. '
        'none: time never waits.',
        choices=TOPICS,
    )
    lockstep_timeout_s: float = parameter(TIMEOUT_S, TIMEOUT_DESCRIPTION, low=0.1, high=3600.0)


class BagPlayerNode(Node):
    """Publishes the messages of a bag at their rate and with their quality of service.

    Ends with the bag. Services: ~/pause (true: pause, false: continue), ~/step (while paused: up to
    and including the next scan).
    """

    def __init__(self) -> None:
        super().__init__('bag_player')
        self._config = parameters.declare_config(
            self, BagPlayerConfig, self._on_config, live=('rate',)
        )
        parameters.reject_unknown(self)
        if not self._config.bag:
            raise ConfigError("bag = '': expected a rosbag2 folder or an MCAP file")
        self._bag = Bag(Path(self._config.bag))
        if self._bag.repair_hint:
            self.get_logger().warning(self._bag.repair_hint)
        self._publishers_by_topic: dict[str, Publisher] = {}
        self._time = self.create_publisher(ClockMsg, '/clock', qos.STREAM)
        self._time_published_s = 0.0
        for topic in self._chosen():
            self._offer(topic)
        topics = set(self._publishers_by_topic)
        self._playback = Playback(self._bag, topics, self._config.start_offset_s, self._config.loop)
        for message in self._playback.known_before:
            self._publishers_by_topic[message.topic].publish(message.data)
        self._start_s: float | None = None
        self._paused = self._config.start_paused
        self._last_tick_s = 0.0
        self._lockstep = Lockstep(self, self._config.lockstep, self._config.lockstep_timeout_s)
        self._unanswered: set[str] = set()  # topics of scans
        self._sent: Counter[str] = Counter()
        self._diagnostics = NodeDiagnostics(self)
        self._diagnostics.add_update_callback(self._publish_diagnostics)
        self.finished = False
        offer(self.create_service, SetBool, '~/pause', self._on_pause)
        offer(self.create_service, Trigger, '~/step', self._on_step)
        self.create_timer(_TICK_S, self._tick, clock=STEADY)

    def close(self) -> None:
        """Wait until the last messages are acknowledged, and log how many were sent."""
        for publisher in self._publishers_by_topic.values():
            publisher.wait_for_all_acked(Duration(seconds=_ACKNOWLEDGE_S))
        counts = sorted(self._sent.items())
        parts = ', '.join(f'{topic} {count}' for topic, count in counts) or 'nothing'
        total = counted(self._sent.total(), 'message')
        self.get_logger().info(f'{self._config.bag}: {total} sent: {parts}')

    def _on_config(self, config: BagPlayerConfig) -> None:
        self._config = config

    def _chosen(self) -> list[str]:
        asked = {topic.strip() for topic in self._config.topics.split(',') if topic.strip()}
        if unknown := asked - set(self._bag.topics):
            has = errors.quoted_names(sorted(self._bag.topics))
            raise InputError(f'{self._config.bag}: no topic {sorted(unknown)[0]}; it has {has}')
        # A recorded clock would contradict the player's own.
        return sorted((asked or set(self._bag.topics)) - {'/clock'})

    def _offer(self, topic: str) -> None:
        """Create the publisher of a topic.

        A type that is not installed, or with other fields, is skipped, unless its topic was chosen
        by name.
        """
        name = f'/{self._config.prefix.strip("/")}{topic}' if self._config.prefix else topic
        profile = qos.as_recorded(topic, self._bag.offers.get(topic, []))
        try:
            kind = message_class(self._bag.topics[topic])
            self._require_same_fields(topic, kind.get_fields_and_field_types())
            self._publishers_by_topic[topic] = self.create_publisher(kind, name, profile)
        except (InputError, NameValidationException) as error:
            reason = ' '.join(str(error).split())[:200]
            if self._config.topics:
                raise InputError(f'{errors.quoted_name(topic)}: {reason}') from error
            self.get_logger().warning(f'{errors.quoted_name(topic)} is not played: {reason}')

    def _require_same_fields(self, topic: str, installed: dict[str, str]) -> None:
        recorded = self._bag.fields(topic)
        was = list(recorded)
        now = list(installed)
        if was == now:
            was, now = (
                [f'{kind} {name}' for name, kind in fields.items() if kind != others[name]]
                for fields, others in ((recorded, installed), (installed, recorded))
            )
        if was and was != now:
            raise InputError(
                f'{self._bag.topics[topic]} of another version, with {", ".join(was)}: '
                f'expected {", ".join(now)}'
            )

    def _has_subscribers(self) -> bool:
        scans = [t for t in self._publishers_by_topic if self._bag.topics[t] == SCAN]
        counts = [
            self._publishers_by_topic[t].get_subscription_count()
            for t in scans or self._publishers_by_topic
        ]
        enough = self._config.wait_for_subscribers
        return all(n >= enough for n in counts) if scans else any(n >= enough for n in counts)

    def _tick(self) -> None:
        now_s = monotonic()
        passed_s = now_s - self._last_tick_s
        self._last_tick_s = now_s
        if self._start_s is None:
            # A node that subscribes to the scans discovers the other topics a moment later.
            self._start_s = now_s + _SETTLE_S if self._has_subscribers() else None
        if self._start_s is None or now_s < self._start_s:
            return
        if not self._paused:
            self._play(passed_s)
        if now_s - self._time_published_s > _CLOCK_PERIOD_S:
            self._time_published_s = now_s
            self._publish_time(self._playback.clock_ns)
        is_answered = not self._lockstep.is_waiting or self._lockstep.timed_out()
        self.finished = self._playback.finished and is_answered

    def _play(self, passed_s: float) -> None:
        """Send what is due. In lockstep, the next scan is held back until the result of the last.

        What is between them is sent: a scan may need odometry that follows it, and the scans of
        other lasers.
        """
        self._playback.advance(1e9 * passed_s * self._config.rate)
        while not self._is_held() and (message := self._playback.pop_due()) is not None:
            self._send(message)

    def _is_held(self) -> bool:
        """Whether a scan is due and a result is missing since the last one of its topic."""
        if self._playback.due_scan not in self._unanswered:
            return False
        if not self._lockstep.is_waiting or self._lockstep.timed_out():
            self._unanswered.clear()
            return False
        # Time spent waiting does not count: the messages keep their intervals.
        self._playback.hold()
        return True

    def _send(self, message: RawMessage) -> None:
        self._publish_time(message.log_ns)
        self._publishers_by_topic[message.topic].publish(message.data)
        self._sent[message.topic] += 1
        if is_scan(message) and self._config.lockstep != NONE:
            self._unanswered.add(message.topic)
            with contextlib.suppress(InputError):  # nothing is published for an invalid scan
                self._lockstep.scan_published(
                    messages.stamp_ns(self._bag.decode(message).header.stamp)
                )

    def _publish_time(self, ns: int) -> None:
        self._time.publish(ClockMsg(clock=messages.time_msg(ns)))

    def _publish_diagnostics(self) -> None:
        is_waiting = self._start_s is None
        text = 'waiting for subscribers' if is_waiting else 'paused' if self._paused else 'playing'
        self._diagnostics.set_state(WARN if is_waiting else OK, text)
        self._diagnostics.set_value('bag time', self._where())
        self._diagnostics.set_value('rounds', self._playback.laps)
        for topic, count in self._sent.items():
            self._diagnostics.set_value(f'{topic}: sent', count)

    def _on_pause(self, request: SetBool.Request) -> str:
        self._paused = request.data
        return f'{"paused" if self._paused else "playing"} at {self._where()}'

    def _on_step(self, _: Trigger.Request) -> str:
        if not self._paused:
            raise InputError('not paused: nothing to step')
        taken = self._playback.step()
        for message in taken:
            self._send(message)
        return f'{counted(len(taken), "message")}, up to {self._where()}'

    def _where(self) -> str:
        return f'{self._playback.clock_ns / 1e9:.3f} s'


main = node_main.program(BagPlayerNode)

if __name__ == '__main__':
    main()
