"""A node between simulator and robot: faults of what they exchange, and the pace of time.

raw_scan, raw_odom, raw_clock, cmd_vel in; scan, odom, /tf, /clock, wheels out. The simulator is
in lockstep with `paced`: it continues when the graph has processed a scan, or with the wall clock
while a fault prevents that, and pauses on request.

Topics `relay_order` and `relay_state` (JSON) connect it with benchmarks/faults/observer.py;
`relay_scan` tells the stamp and the true time of each scan.
"""

import json
from dataclasses import dataclass
from time import monotonic

from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rosgraph_msgs.msg import Clock as ClockMsg
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from benchmarks.faults.stream_faults import StreamFaults
from thinmap_msgs.msg import TopologicalMap
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.ros import messages, node_main, qos

# No fault of the clock leads to a stamp below zero.
OFFSET_NS = 1000 * SECOND_NS
_TICK_S = 0.01
_STATE_S = 0.1
_SCAN_S = 0.2
_PATIENCE_S = 5.0  # for a busy machine; nothing is awaited that never comes, but after a restart
_DEEP = 1000


@dataclass
class _Pace:
    """Whether the simulation may continue.

    awaited_ns: stamp of the last scan at the simulator while it waits, and as it was passed on.
    """

    holds: bool = True
    is_free: bool = False
    awaited_ns: int | None = None
    passed_ns: int = 0
    since_s: float = 0.0
    is_done: bool = False

    def scan(self, raw_ns: int, passed_ns: int, is_done: bool) -> None:
        self.awaited_ns = raw_ns
        self.passed_ns = passed_ns
        self.since_s = monotonic()
        self.is_done = is_done

    def result(self, stamp_ns: int) -> None:
        self.is_done = self.is_done or stamp_ns == self.passed_ns

    def released(self) -> int | None:
        """The awaited stamp, once the simulation continues."""
        waited_s = monotonic() - self.since_s
        limit_s = _SCAN_S if self.is_free else _PATIENCE_S
        if self.holds or self.awaited_ns is None or not (self.is_done or waited_s > limit_s):
            return None
        released_ns = self.awaited_ns
        self.awaited_ns = None
        return released_ns


class FaultRelay(Node):
    """The relay."""

    def __init__(self) -> None:
        super().__init__('fault_relay')
        self._faults = StreamFaults(OFFSET_NS)
        self._pace = _Pace()
        self._counts = {'scan': 0, 'odom': 0, 'dropped_scan': 0}
        self._out = {
            'scan': self.create_publisher(LaserScan, 'scan', qos.STREAM),
            'odom': self.create_publisher(Odometry, 'odom', qos.STREAM),
            'tf': self.create_publisher(TFMessage, '/tf', qos.STREAM),
            'clock': self.create_publisher(ClockMsg, '/clock', qos.STREAM),
            'wheels': self.create_publisher(Twist, 'wheels', qos.STREAM),
            'paced': self.create_publisher(TopologicalMap, 'paced', qos.STREAM),
            'state': self.create_publisher(String, 'relay_state', qos.STREAM),
            'stamp': self.create_publisher(String, 'relay_scan', qos.STREAM),
        }
        self.create_subscription(LaserScan, 'raw_scan', self._on_scan, _DEEP)
        self.create_subscription(Odometry, 'raw_odom', self._on_odometry, _DEEP)
        self.create_subscription(ClockMsg, '/raw_clock', self._on_clock, _DEEP)
        self.create_subscription(Twist, 'cmd_vel', self._on_command, _DEEP)
        self.create_subscription(TopologicalMap, 'local_topology', self._on_result, qos.STREAM)
        self.create_subscription(String, 'relay_order', self._on_order, _DEEP)
        wall = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_TICK_S, self._release, clock=wall)
        self.create_timer(_STATE_S, self._publish_state, clock=wall)

    def _on_clock(self, message: ClockMsg) -> None:
        stamp_ns = self._faults.clock(messages.stamp_ns(message.clock))
        self._out['clock'].publish(ClockMsg(clock=messages.time_msg(stamp_ns)))

    def _on_scan(self, message: LaserScan) -> None:
        raw_ns = messages.stamp_ns(message.header.stamp)
        passed = self._faults.scan(message)
        stamp_ns = messages.stamp_ns(message.header.stamp)
        self._out['stamp'].publish(String(data=json.dumps([stamp_ns, raw_ns])))
        for each in passed:
            self._out['scan'].publish(each)
        self._counts['scan'] += len(passed)
        self._counts['dropped_scan'] += not passed and not self._faults.is_silent
        self._pace.scan(raw_ns, stamp_ns, is_done=False)
        self._release()

    def _on_odometry(self, message: Odometry) -> None:
        for each in self._faults.odometry(message):
            self._out['odom'].publish(each)
            self._counts['odom'] += 1
            T_odom_base = messages.pose_from_msg(each.pose.pose)
            stamp_ns = messages.stamp_ns(each.header.stamp)
            transform = messages.transform_msg(T_odom_base, 'odom', 'base_link', stamp_ns)
            self._out['tf'].publish(TFMessage(transforms=[transform]))

    def _on_command(self, message: Twist) -> None:
        self._out['wheels'].publish(Twist() if self._faults.blocks_wheels else message)

    def _on_result(self, message: TopologicalMap) -> None:
        self._pace.result(messages.stamp_ns(message.header.stamp))
        self._release()

    def _on_order(self, message: String) -> None:
        order = json.loads(message.data)
        if 'begin' in order:
            self._faults.begin(order['begin'], order['seed'])
        if 'end' in order:
            self._faults.end()
        self._pace.holds = order.get('holds', self._pace.holds)
        self._pace.is_free = order.get('is_free', self._pace.is_free)
        self._publish_state()

    def _release(self) -> None:
        released_ns = self._pace.released()
        if released_ns is not None:
            header = messages.header('map', released_ns)
            self._out['paced'].publish(TopologicalMap(header=header))

    def _publish_state(self) -> None:
        is_held = self._pace.holds and self._pace.awaited_ns is not None
        self._out['state'].publish(String(data=json.dumps({**self._counts, 'is_held': is_held})))


def main() -> None:
    """Run the node."""
    node_main.run(FaultRelay)


if __name__ == '__main__':
    main()
