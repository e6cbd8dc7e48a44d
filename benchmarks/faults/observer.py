"""What is seen of a live graph: poses, commands, collisions, diagnostics, state of the relay."""

import json
from dataclasses import dataclass
from time import monotonic
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String, UInt32

from benchmarks.faults.judge import Counts, Passed
from benchmarks.faults.track import MapWatch, Track
from benchmarks.goal_client import Interruption
from thinmap_msgs.msg import SlamStatus
from thinmap_ros.core.se2 import Array
from thinmap_ros.ros import messages, qos
from thinmap_ros.sim.world import World

_DEEP = QoSProfile(depth=1000)
# States in which no scan may be drawn into the map.
_NOTHING_DRAWN = {
    getattr(SlamStatus, name) for name in ('LOST', 'MAPPING_APART') if hasattr(SlamStatus, name)
}
_LOST = 'lost in transport or in a full queue'
_GAPS = 'gaps between the stamps'


@dataclass
class Health:
    """Last diagnostics of a node; heard_s: when it was received (monotonic)."""

    values: dict[str, str]
    is_ok: bool
    message: str
    heard_s: float

    def counts(self, topic: str) -> Counts | None:
        """Counts of a topic; None if the node has not subscribed to it."""
        received = self.values.get(f'{topic}: received')
        if received is None:
            return None
        lost = int(self.values.get(f'dropped: {topic}: {_LOST}', '0'))
        return Counts(int(received), lost, int(self.values.get(f'dropped: {topic}: {_GAPS}', '0')))


class Observer:
    """A node that listens. Others may use it as their node, too."""

    def __init__(self, world: World) -> None:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self._interruption = Interruption()
        self.node = rclpy.create_node('endurance')
        self.track = Track()
        self.map = MapWatch(world, self.track)
        self.health: dict[str, Health] = {}
        self.collisions = 0
        self.moving_commands = 0
        self.is_held = False  # time stands still
        self._relayed: dict[str, int] = {}
        self._last_pose: tuple[int, Array] | None = None
        self._orders = self.node.create_publisher(String, 'relay_order', _DEEP)
        self._teleports = self.node.create_publisher(PoseStamped, 'sim/set_pose', qos.STREAM)
        for kind, topic, hear in (
            (PoseStamped, 'ground_truth', self._on_truth),
            (PoseWithCovarianceStamped, 'pose', self._on_pose),
            (SlamStatus, 'slam_status', self._on_status),
            (Twist, 'cmd_vel', self._on_command),
            (DiagnosticArray, '/diagnostics', self._on_diagnostics),
            (String, 'relay_state', self._on_relay_state),
            (String, 'relay_scan', self._on_relay_scan),
        ):
            self.node.create_subscription(kind, topic, hear, _DEEP)
        self.node.create_subscription(OccupancyGrid, 'map', self._on_map, qos.LATCHED)
        self.node.create_subscription(UInt32, 'collisions', self._on_collisions, qos.LATCHED)

    def is_connected(self) -> bool:
        """Whether the relay receives orders, and the simulator places."""
        return bool(self._orders.get_subscription_count()) and bool(
            self._teleports.get_subscription_count()
        )

    def passed(self) -> Passed:
        """Messages that the relay has passed on."""
        counts = self._relayed
        return Passed({t: counts.get(t, 0) for t in ('scan', 'odom')}, counts['dropped_scan'])

    def order(self, **values: Any) -> None:
        """Give the relay an order."""
        self.is_held = False
        self._orders.publish(String(data=json.dumps(values)))

    def teleport(self, T_world_base: Array) -> None:
        """Put the robot at a pose (3,)."""
        self.track.teleported()
        self._teleports.publish(messages.pose_stamped_msg(T_world_base, 'world', 0))

    def align_map(self) -> None:
        """Let the map lie where the last pose is the true one."""
        if self._last_pose is not None:
            stamp_ns, pose = self._last_pose
            self.track.align(pose, stamp_ns)
            self.map.restart()

    def spin(self) -> None:
        """Process what was received. Raises KeyboardInterrupt after Ctrl-C."""
        rclpy.spin_once(self.node, timeout_sec=0.02)
        self._interruption.check()

    def close(self) -> None:
        """End the node."""
        self.node.destroy_node()
        rclpy.try_shutdown()

    def _on_truth(self, message: PoseStamped) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        self.track.add_truth(stamp_ns, messages.pose_from_msg(message.pose))

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        pose = messages.pose_from_msg(message.pose.pose)
        self._last_pose = (stamp_ns, pose)
        self.track.add_pose(stamp_ns, pose)

    def _on_status(self, message: SlamStatus) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        self.track.add_state(stamp_ns, message.state == SlamStatus.TRACKING)
        self.map.add_state(stamp_ns, message.state in _NOTHING_DRAWN)

    def _on_map(self, message: OccupancyGrid) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        self.map.add_map(stamp_ns, messages.grid_from_msg(message))

    def _on_command(self, message: Twist) -> None:
        self.moving_commands += message.linear.x != 0.0 or message.angular.z != 0.0

    def _on_collisions(self, message: UInt32) -> None:
        self.collisions = int(message.data)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.health[status.name.partition(':')[0]] = Health(
                {pair.key: pair.value for pair in status.values},
                status.level == DiagnosticStatus.OK,
                status.message,
                monotonic(),
            )

    def _on_relay_state(self, message: String) -> None:
        self._relayed = json.loads(message.data)
        self.is_held = bool(self._relayed.pop('is_held'))

    def _on_relay_scan(self, message: String) -> None:
        stamp_ns, true_ns = json.loads(message.data)
        self.track.add_scan(stamp_ns, true_ns)
