"""Records all topics into an MCAP bag."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError, counted
from thinmap_ros.files import package_data
from thinmap_ros.logs import storage
from thinmap_ros.logs.bag_writer import BagWriter
from thinmap_ros.ros import node_main, parameters
from thinmap_ros.ros.diagnostics import NodeDiagnostics
from thinmap_ros.ros.messages import message_class
from thinmap_ros.ros.time_jumps import STEADY

_DISCOVERY_PERIOD_S = 0.25
_FLUSH_S = 0.5
_DEPTH = 1000


@dataclass(frozen=True)
class RecorderConfig(Config):
    """Parameters of the recorder."""

    bag: str = parameter('bag', 'rosbag2 folder to write. It must not exist yet.')


class RecorderNode(Node):
    """Subscribes to each topic as soon as it has a publisher, and writes its serialized messages.

    A message is on the disk within half a second, whatever ends the robot. When the disk is full,
    the node ends with an error.
    """

    def __init__(self) -> None:
        super().__init__('recorder')
        self._path = Path(parameters.declare_config(self, RecorderConfig).bag)
        parameters.reject_unknown(self)
        if self._path.exists():
            raise InputError(f'{self._path}: exists already: expected the name of a new bag')
        try:
            self._writer = BagWriter(self._path, live=True)
        except OSError as error:
            raise InputError(f'{self._path}: {error.strerror or error}') from error
        self._seen: set[str] = {'/rosout', '/parameter_events'}
        self._early: list[tuple[str, str, bytes]] = []
        self._written = 0
        self._diagnostics = NodeDiagnostics(self)
        # Not in the robot's time, which may stand still until all subscribers are there.
        self.create_timer(_DISCOVERY_PERIOD_S, self._discover_topics, clock=STEADY)
        self.create_timer(_FLUSH_S, lambda: self._guarded(self._writer.flush), clock=STEADY)

    def close(self) -> None:
        """Finish the bag; one cut off by a full disk is readable, and `bag_repair` completes it."""
        with contextlib.suppress(OSError):
            for message in self._early:
                self._write(*message, self.get_clock().now().nanoseconds)
            self._writer.close()
        self._diagnostics.end()
        self.get_logger().info(f'{self._path}: {counted(self._written, "message")}')

    def _discover_topics(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            # Feedback and status of an action are also published on topics of their own.
            if (
                '/_action/' not in topic
                and topic not in self._seen
                and self.count_publishers(topic) > 0
            ):
                self._seen.add(topic)
                self._subscribe(topic, types[0])

    def _subscribe(self, topic: str, type_name: str) -> None:
        offers = [info.qos_profile for info in self.get_publishers_info_by_topic(topic)]
        reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
        latched = all(offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
        try:
            kind = message_class(type_name)
            self._writer.add_definitions(
                package_data.message_definitions(type_name.partition('/')[0])
            )
            self._writer.add_topic(
                topic, type_name, [storage.recorded(o.depth, reliable, latched) for o in offers]
            )
        except InputError as error:
            self.get_logger().warning(f'{topic} is not recorded: {error}')
            return
        self.create_subscription(
            kind, topic, self._callback(topic, type_name), _common_qos(reliable, latched), raw=True
        )

    def _callback(self, topic: str, type_name: str) -> Callable[[bytes], None]:
        def process(data: bytes) -> None:
            self._guarded(lambda: self._process(topic, type_name, data))

        return process

    def _process(self, topic: str, type_name: str, data: bytes) -> None:
        ns = self.get_clock().now().nanoseconds
        if ns == 0 and len(self._early) < _DEPTH:
            # Time has not begun: these messages get the first time, so that a player does not wait.
            self._early.append((topic, type_name, data))
            return
        for message in self._early:
            self._write(*message, ns)
        self._early.clear()
        self._write(topic, type_name, data, ns)

    def _write(self, topic: str, type_name: str, data: bytes, ns: int) -> None:
        with self._diagnostics.time_step('writing'):
            self._writer.write(topic, type_name, ns, data)
        self._written += 1
        self._diagnostics.set_value('messages written', self._written)

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except OSError as error:
            raise InputError(
                f'{self._path}: {error.strerror or error}: recording ends here'
            ) from error


def _common_qos(reliable: bool, latched: bool) -> QoSProfile:
    """The quality of service that all publishers of a topic offer."""
    return QoSProfile(
        depth=_DEPTH,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


main = node_main.program(RecorderNode)

if __name__ == '__main__':
    main()
