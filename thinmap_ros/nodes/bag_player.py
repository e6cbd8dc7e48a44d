"""A bag onto the graph, with /clock: what robots heard, for the nodes of today."""

import contextlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock as ClockMsg
from std_srvs.srv import SetBool, Trigger

from thinmap_ros.core import validation
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError, InputError
from thinmap_ros.logs.bag import Bag
from thinmap_ros.logs.playback import Playback, is_scan
from thinmap_ros.logs.storage import RawMessage
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.diagnostics import OK, WARN, Health
from thinmap_ros.ros.lockstep import NONE, PATIENCE_S, PATIENCE_WORDS, TOPICS, Lockstep
from thinmap_ros.ros.messages import message_class
from thinmap_ros.ros.services import answer

_TICK_S = 0.002
_CLOCK_PERIOD_S = 0.02
_ACKNOWLEDGE = Duration(seconds=1.0)
_SETTLE_S = 0.5
_SCAN = 'sensor_msgs/msg/LaserScan'


@dataclass(frozen=True)
class BagPlayerConfig(Config):
    """Parameters of the player."""

    bag: str = parameter('', 'rosbag2 folder or MCAP file')
    topics: str = parameter('', 'topics to play, separated by commas; empty: all')
    prefix: str = parameter('', 'put before each topic: robot1 makes /scan /robot1/scan')
    rate: float = parameter(1.0, 'bag seconds a second', low=0.01, high=1000.0)
    start_offset_s: float = parameter(0.0, 'begin so far into the bag, s', low=0.0)
    loop: bool = parameter(False, 'begin again at the end')
    start_paused: bool = parameter(False, 'wait for ~/pause or ~/step')
    wait_for_subscribers: int = parameter(
        1,
        'begin when every scan topic (or, without one, any topic) has so many subscribers',
        low=0,
        high=100,
    )
    lockstep: str = parameter(
        NONE, 'wait for what each scan leads to: nothing is lost at high rates', choices=TOPICS
    )
    lockstep_patience_s: float = parameter(PATIENCE_S, PATIENCE_WORDS, low=0.1, high=3600.0)


class BagPlayerNode(Node):
    """Publishes the bytes of a bag in its rhythm and as offered, counts them, ends with the bag.

    Services: ~/pause (true: stand still, false: go on), ~/step (while it stands still: up to and
    with the next scan).
    """

    def __init__(self) -> None:
        super().__init__('bag_player')
        self._config = parameters.declare(self, BagPlayerConfig, self._on_config, live=('rate',))
        parameters.check_unknown(self)
        if not self._config.bag:
            raise ConfigError("bag = '': expected a rosbag2 folder or an MCAP file")
        self._bag = Bag(Path(self._config.bag))
        if self._bag.repair_hint:
            self.get_logger().warning(self._bag.repair_hint)
        self._publishers_by_topic: dict[str, Publisher] = {}
        self._clock_topic = self.create_publisher(ClockMsg, '/clock', qos.STREAM)
        for topic in self._chosen():
            self._offer(topic)
        topics = set(self._publishers_by_topic)
        self._playback = Playback(self._bag, topics, self._config.start_offset_s, self._config.loop)
        for message in self._playback.known_before:
            self._publishers_by_topic[message.topic].publish(message.data)
        self._begins_at: float | None = None
        self._paused = self._config.start_paused
        self._ticked_at = self._clock_at = 0.0
        self._lockstep = Lockstep(self, self._config.lockstep, self._config.lockstep_patience_s)
        self._sent: Counter[str] = Counter()
        self._health = Health(self)
        self._health.before_telling(self._tell_health)
        self.finished = False
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/step', self._on_step)
        self.create_timer(_TICK_S, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def close(self) -> None:
        """See the last messages through to those who listen, and say what was done."""
        for publisher in self._publishers_by_topic.values():
            publisher.wait_for_all_acked(_ACKNOWLEDGE)
        counts = sorted(self._sent.items())
        parts = ', '.join(f'{topic} {count}' for topic, count in counts) or 'nothing'
        self.get_logger().info(f'{self._config.bag}: {self._sent.total()} messages sent: {parts}')

    def _on_config(self, config: BagPlayerConfig) -> None:
        self._config = config

    def _chosen(self) -> list[str]:
        asked = {topic.strip() for topic in self._config.topics.split(',') if topic.strip()}
        if unknown := asked - set(self._bag.topics):
            has = validation.quoted_names(sorted(self._bag.topics))
            raise InputError(f'{self._config.bag}: no topic {sorted(unknown)[0]}; it has {has}')
        # A recorded clock would run against the player's own.
        return sorted((asked or set(self._bag.topics)) - {'/clock'})

    def _offer(self, topic: str) -> None:
        """Make the publisher of a topic.

        What is not installed here is left out, unless it was asked for by name.
        """
        name = f'/{self._config.prefix.strip("/")}{topic}' if self._config.prefix else topic
        profile = qos.as_recorded(topic, self._bag.offers.get(topic, []))
        try:
            kind = message_class(self._bag.topics[topic])
            self._publishers_by_topic[topic] = self.create_publisher(kind, name, profile)
        except (InputError, NameValidationException) as error:
            reason = ' '.join(str(error).split())[:200]
            if self._config.topics:
                raise InputError(f'{validation.quoted_name(topic)}: {reason}') from error
            self.get_logger().warning(f'{validation.quoted_name(topic)} is not played: {reason}')

    def _has_listeners(self) -> bool:
        scans = [t for t in self._publishers_by_topic if self._bag.topics[t] == _SCAN]
        counts = [
            self._publishers_by_topic[t].get_subscription_count()
            for t in scans or self._publishers_by_topic
        ]
        enough = self._config.wait_for_subscribers
        return all(n >= enough for n in counts) if scans else any(n >= enough for n in counts)

    def _tick(self) -> None:
        now = monotonic()
        passed_s = now - self._ticked_at
        self._ticked_at = now
        if self._begins_at is None:
            # Who listens to scans finds the other topics a moment later.
            self._begins_at = now + _SETTLE_S if self._has_listeners() else None
        if self._begins_at is None or now < self._begins_at:
            return
        # Time that was waited does not count: what follows keeps its rhythm.
        if not self._paused and (not self._lockstep.waits or self._lockstep.give_up()):
            self._play(passed_s)
        if now - self._clock_at > _CLOCK_PERIOD_S:
            self._clock_at = now
            self._tell_time(self._playback.clock_ns)
        self.finished = self._playback.finished and not self._lockstep.waits

    def _play(self, passed_s: float) -> None:
        self._playback.advance(1e9 * passed_s * self._config.rate)
        while not self._lockstep.waits and (message := self._playback.pop_due()) is not None:
            self._send(message)

    def _send(self, message: RawMessage) -> None:
        self._tell_time(message.log_ns)
        self._publishers_by_topic[message.topic].publish(message.data)
        self._sent[message.topic] += 1
        if is_scan(message) and self._config.lockstep != NONE:
            with contextlib.suppress(InputError):  # a broken scan leads to nothing
                self._lockstep.sent(messages.stamp_ns(self._bag.decode(message).header.stamp))

    def _tell_health(self) -> None:
        waits = self._begins_at is None
        words = 'waiting for subscribers' if waits else 'paused' if self._paused else 'playing'
        self._health.state(WARN if waits else OK, words)
        self._health.tell('bag time', self._where())
        self._health.tell('rounds', self._playback.laps)
        for topic, count in self._sent.items():
            self._health.tell(f'{topic}: sent', count)

    def _tell_time(self, ns: int) -> None:
        self._clock_topic.publish(ClockMsg(clock=messages.time_msg(ns)))

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._paused = request.data
        return answer(
            response, lambda: f'{"paused" if self._paused else "playing"} at {self._where()}'
        )

    def _on_step(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return answer(response, self._step)

    def _step(self) -> str:
        if not self._paused:
            raise InputError('not paused: nothing to step')
        taken = self._playback.step()
        for message in taken:
            self._send(message)
        return f'{len(taken)} messages, up to {self._where()}'

    def _where(self) -> str:
        return f'{self._playback.clock_ns / 1e9:.3f} s'


def main() -> None:
    """Run the node."""
    node_main.run(BagPlayerNode)


if __name__ == '__main__':
    main()
