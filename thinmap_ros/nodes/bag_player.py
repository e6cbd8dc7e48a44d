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
from thinmap_ros.adapters.types import message_class
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError, InputError

_TICK_S = 0.002
_ACKNOWLEDGE = Duration(seconds=1.0)
_LOCKSTEP_PATIENCE_S = 2.0
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
    lockstep: bool = parameter(False, 'wait for /pose of each scan: nothing is lost at high rates')


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
            profile = qos.STATIC_TRANSFORMS if topic.endswith('tf_static') else qos.STREAM
            self._publishers_by_topic[topic] = self.create_publisher(kind, topic, profile)
        self._messages: Iterator[RawMessage] = self._bag.messages(self._topics)
        self._next: RawMessage | None = next(self._messages, None)
        self._first_ns = 0 if self._next is None else self._next.log_ns
        self._begun_at: float | None = None
        self._awaited_ns: int | None = None
        self._awaited_since = 0.0
        self.sent = 0
        self.finished = False
        if self._config.lockstep:
            pose = message_class('geometry_msgs/msg/PoseWithCovarianceStamped')
            self.create_subscription(pose, 'pose', self._on_pose, qos.STREAM)
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

    def _on_pose(self, message: object) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)  # type: ignore[attr-defined]
        if stamp_ns == self._awaited_ns:
            self._awaited_ns = None

    def _has_listeners(self) -> bool:
        scans = [t for t in self._topics if self._bag.topics[t] == _SCAN]
        counts = [self.count_subscribers(topic) for topic in scans or self._topics]
        enough = self._config.wait_for_subscribers
        return all(n >= enough for n in counts) if scans else any(n >= enough for n in counts)

    def _tick(self) -> None:
        if self._begun_at is None:
            if self._has_listeners():
                self._begun_at = monotonic()
            return
        if self._awaited_ns is not None and self._waits():
            return
        played_ns = self._first_ns + int((monotonic() - self._begun_at) * self._config.rate * 1e9)
        while self._next is not None and self._next.log_ns <= played_ns and self._awaited_ns is None:
            self._send(self._next)
            self._next = next(self._messages, None)
        self.finished = self._next is None and self._awaited_ns is None

    def _waits(self) -> bool:
        waited = monotonic() - self._awaited_since
        if waited > _LOCKSTEP_PATIENCE_S:
            self.get_logger().warning('no /pose for the last scan: going on without it')
            self._awaited_ns = None
        # Time that was waited does not count: what follows keeps its rhythm.
        elif self._begun_at is not None:
            self._begun_at += _TICK_S
        return self._awaited_ns is not None

    def _send(self, message: RawMessage) -> None:
        self._clock_topic.publish(ClockMsg(clock=messages.time_msg(message.log_ns)))
        self._publishers_by_topic[message.topic].publish(message.data)
        self.sent += 1
        if self._config.lockstep and message.type_name == _SCAN:
            decoded = self._bag.decode(message)
            self._awaited_ns = messages.stamp_ns(decoded.header.stamp)
            self._awaited_since = monotonic()


def main() -> None:
    """Run the node."""
    runtime.run(BagPlayerNode)


if __name__ == '__main__':
    main()
