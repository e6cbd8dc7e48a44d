"""Everything that is said on the graph, into an MCAP bag."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from thinmap_ros.adapters import parameters, resources, runtime
from thinmap_ros.adapters.bags import BagWriter
from thinmap_ros.adapters.types import message_class
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError

_LOOK_AROUND_S = 0.25
_DEPTH = 1000
_OWN_MESSAGES = ('thinmap_msgs', 'tf2_msgs')


@dataclass(frozen=True)
class RecorderConfig(Config):
    """Parameters of the recorder."""

    bag: str = parameter('bag', 'rosbag2 folder to write; it must not exist yet')


class RecorderNode(Node):
    """Subscribes to every topic as soon as somebody publishes it, and writes the bytes as they come."""

    def __init__(self) -> None:
        super().__init__('recorder')
        path = Path(parameters.declare(self, RecorderConfig).bag)
        parameters.check_unknown(self)
        if path.exists():
            raise InputError(f'{path}: exists already: expected the name of a new bag')
        definitions: dict[str, str] = {}
        for package in _OWN_MESSAGES:
            definitions |= resources.message_definitions(package)
        self._writer = BagWriter(path, live=True, definitions=definitions)
        self._seen: set[str] = {'/rosout', '/parameter_events'}
        # Not in the robot's time, which may stand still until everybody listens.
        self.create_timer(_LOOK_AROUND_S, self._look_around, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def close(self) -> None:
        """Finish the bag."""
        self._writer.close()

    def _look_around(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            # What an action says under way is repeated on topics of its own.
            if '/_action/' not in topic and topic not in self._seen and self.count_publishers(topic) > 0:
                self._seen.add(topic)
                self._subscribe(topic, types[0])

    def _subscribe(self, topic: str, type_name: str) -> None:
        try:
            kind = message_class(type_name)
        except InputError as error:
            self.get_logger().warning(f'{topic} is not recorded: {error}')
            return
        self.create_subscription(kind, topic, self._writes(topic, type_name), self._offered(topic), raw=True)

    def _writes(self, topic: str, type_name: str) -> Callable[[bytes], None]:
        def write(data: bytes) -> None:
            self._writer.write(topic, type_name, self.get_clock().now().nanoseconds, data)

        return write

    def _offered(self, topic: str) -> QoSProfile:
        """What every publisher of a topic offers at least, so that all of them are heard."""
        offers = [info.qos_profile for info in self.get_publishers_info_by_topic(topic)]
        reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
        latched = all(offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
        return QoSProfile(
            depth=_DEPTH,
            history=HistoryPolicy.KEEP_LAST,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )


def main() -> None:
    """Run the node."""
    runtime.run(RecorderNode)


if __name__ == '__main__':
    main()
