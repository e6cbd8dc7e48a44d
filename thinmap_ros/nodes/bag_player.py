"""A bag onto the graph, with /clock: what robots heard, for the nodes of today."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock as ClockMsg

from thinmap_ros.adapters import messages, parameters, qos, runtime
from thinmap_ros.adapters.bags import Bag, RawMessage
from thinmap_ros.adapters.lockstep import NONE, TOPICS, Lockstep
from thinmap_ros.adapters.types import message_class
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError, InputError

_TICK_S = 0.002
_ACKNOWLEDGE = Duration(seconds=1.0)
_SETTLE_S = 0.5
_STATIC = 'tf_static'
_SCAN = 'sensor_msgs/msg/LaserScan'


@dataclass(frozen=True)
class BagPlayerConfig(Config):
    """Parameters of the player."""

    bag: str = parameter('', 'rosbag2 folder or MCAP file')
    topics: str = parameter('', 'topics to play, separated by commas; empty: all')
    rate: float = parameter(1.0, 'bag seconds a second', low=0.01, high=1000.0)
    wait_for_subscribers: int = parameter(
        1, 'begin when every scan topic (or, without one, any topic) has so many subscribers', low=0, high=100
    )
    lockstep: str = parameter(NONE, 'wait for what each scan leads to: nothing is lost at high rates', choices=TOPICS)


class BagPlayerNode(Node):
    """Publishes the bytes of a bag in its own rhythm, counts them, and ends with the bag."""

    def __init__(self) -> None:
        super().__init__('bag_player')
        self._config = parameters.declare(self, BagPlayerConfig)
        parameters.check_unknown(self)
        if not self._config.bag:
            raise ConfigError("bag = '': expected a rosbag2 folder or an MCAP file")
        self._bag = Bag(Path(self._config.bag))
        self._topics = self._chosen()
        self._publishers_by_topic: dict[str, Publisher] = {}
        self._clock_topic = self.create_publisher(ClockMsg, '/clock', qos.STREAM)
        for topic in sorted(self._topics):
            kind = message_class(self._bag.topics[topic])
            profile = qos.STATIC_TRANSFORMS if topic.endswith(_STATIC) else qos.STREAM
            self._publishers_by_topic[topic] = self.create_publisher(kind, topic, profile)
        # Where the sensors sit is known before anything is sensed.
        for message in self._bag.messages({topic for topic in self._topics if topic.endswith(_STATIC)}):
            self._publishers_by_topic[message.topic].publish(message.data)
        self._messages: Iterator[RawMessage] = self._bag.messages(self._topics)
        self._next: RawMessage | None = next(self._messages, None)
        self._first_ns = 0 if self._next is None else self._next.log_ns
        self._begun_at: float | None = None
        self._lockstep = Lockstep(self, self._config.lockstep)
        self.sent = 0
        self.finished = False
        self.create_timer(_TICK_S, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def close(self) -> None:
        """See the last messages through to those who listen, and say what was done."""
        for publisher in self._publishers_by_topic.values():
            publisher.wait_for_all_acked(_ACKNOWLEDGE)
        self.get_logger().info(f'{self._config.bag}: {self.sent} messages sent')

    def _chosen(self) -> set[str]:
        asked = {topic.strip() for topic in self._config.topics.split(',') if topic.strip()}
        if unknown := asked - set(self._bag.topics):
            raise InputError(
                f'{self._config.bag}: no topic {sorted(unknown)[0]}; it has {", ".join(sorted(self._bag.topics))}'
            )
        # A recorded clock would run against the player's own.
        return (asked or set(self._bag.topics)) - {'/clock'}

    def _has_listeners(self) -> bool:
        scans = [t for t in self._topics if self._bag.topics[t] == _SCAN]
        counts = [self.count_subscribers(topic) for topic in scans or self._topics]
        enough = self._config.wait_for_subscribers
        return all(n >= enough for n in counts) if scans else any(n >= enough for n in counts)

    def _tick(self) -> None:
        if self._begun_at is None:
            # Who listens to scans finds the other topics a moment later.
            self._begun_at = monotonic() + _SETTLE_S if self._has_listeners() else None
            return
        if self._lockstep.waits and not self._lockstep.give_up():
            # Time that was waited does not count: what follows keeps its rhythm.
            self._begun_at += _TICK_S
            return
        played_ns = self._first_ns + int((monotonic() - self._begun_at) * self._config.rate * 1e9)
        while self._next is not None and self._next.log_ns <= played_ns and not self._lockstep.waits:
            self._send(self._next)
            self._next = next(self._messages, None)
        self.finished = self._next is None and not self._lockstep.waits

    def _send(self, message: RawMessage) -> None:
        self._clock_topic.publish(ClockMsg(clock=messages.time_msg(message.log_ns)))
        self._publishers_by_topic[message.topic].publish(message.data)
        self.sent += 1
        if message.type_name == _SCAN:
            self._lockstep.sent(messages.stamp_ns(self._bag.decode(message).header.stamp))


def main() -> None:
    """Run the node."""
    runtime.run(BagPlayerNode)


if __name__ == '__main__':
    main()
