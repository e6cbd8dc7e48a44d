"""Parts of the simulator: robots on topics, their starts, and an exploration on request."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import LaserScan
from std_msgs.msg import UInt32
from tf2_msgs.msg import TFMessage

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import ExplorationStatus
from thinmap_ros.core import se2
from thinmap_ros.core.errors import ConfigError, InputError, quoted
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.core.se2 import Array
from thinmap_ros.files.worlds import read_starts
from thinmap_ros.logs.transforms import parse_pose
from thinmap_ros.nodes.parts.progress import doing
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.diagnostics import NodeDiagnostics
from thinmap_ros.ros.maps import received_map, received_update, updates_topic
from thinmap_ros.ros.services import action_servers
from thinmap_ros.ros.velocity import TOPIC as COMMANDS
from thinmap_ros.ros.velocity import VelocitySubscription
from thinmap_ros.sim.other_robots import starts_in, starts_side_by_side
from thinmap_ros.sim.simulation import SensorReadings, Simulation
from thinmap_ros.sim.world import World

# A request before the new server has discovered its client is lost.
_REQUESTS = 40
# Without an answer for this time, the goal is sent again: an explorer that has just been discovered
# may be unable to answer.
_RESEND_S = 10.0


class RequestedExploration:
    """Client of the action explore of a robot; its names begin with a prefix, '' or 'robot1/'.

    What was requested of a server is lost when it is killed. One that takes its place continues
    the goal, or answers that it does not know it, with STATUS_UNKNOWN.
    status: the newest one, None before; result: ready for JSON, None before the end.
    """

    def __init__(
        self,
        node: Node,
        prefix: str,
        time_limit_s: float,
        on_map: Callable[[GridPatch], None],
        on_progress: Callable[[], None],
    ) -> None:
        """time_limit_s: simulated time after which the exploration ends; 0: none.

        on_map: receives each map; on_progress: called for each new status.
        """
        self.status: ExplorationStatus | None = None
        self.result: dict[str, Any] | None = None
        self._node = node
        self._goal = Explore.Goal(time_limit_s=time_limit_s)
        self._action = f'{prefix}explore'
        self._on_progress = on_progress
        self._sent: Any = None
        self._sent_at = 0.0
        self._handle: ClientGoalHandle | None = None
        self._servers: set[bytes] = set()  # that were asked for the result
        self._requests_left = 0
        self._client = ActionClient(node, Explore, self._action)
        self._subscribe(f'{prefix}map', on_map)

    def _subscribe(self, topic: str, on_map: Callable[[GridPatch], None]) -> None:
        receiver = MapReceiver()

        def on_update(message: OccupancyGridUpdate) -> None:
            with suppress(InputError):  # of a map that has not come yet
                patch = received_update(receiver, message)
                if patch is not None:
                    on_map(patch)

        def on_whole(message: OccupancyGrid) -> None:
            on_map(received_map(receiver, message))

        node = self._node
        node.create_subscription(OccupancyGrid, topic, on_whole, qos.LATCHED)
        updates = updates_topic(node, topic)
        node.create_subscription(OccupancyGridUpdate, updates, on_update, qos.STREAM)

    def work(self) -> None:
        """Send the goal, again if there is no answer for a while; ask again for its result.

        To be called twice a second.
        """
        if self.result is not None:
            return
        if self._handle is not None:
            self._ask_again(self._handle)
            return
        is_waiting = self._sent is not None and monotonic() - self._sent_at < _RESEND_S
        if is_waiting or not self._client.server_is_ready():
            return
        self._sent_at = monotonic()
        self._sent = self._client.send_goal_async(self._goal, self._on_feedback)
        self._sent.add_done_callback(self._on_accepted)

    def _ask_again(self, handle: ClientGoalHandle) -> None:
        """Ask each new server for the result, some times."""
        servers = action_servers(self._node, self._action)
        if servers - self._servers:
            self._servers |= servers
            self._requests_left = _REQUESTS
        if self._requests_left > 0:
            self._requests_left -= 1
            handle.get_result_async().add_done_callback(self._on_result)

    @property
    def doing(self) -> str:
        """What the robot does, in words; '' before the first status."""
        return '' if self.status is None else doing(self.status)

    def _on_accepted(self, future: Future) -> None:
        if future is not self._sent:
            return  # replaced by a newer goal
        handle = future.result()
        self._handle = handle
        self._servers = action_servers(self._node, self._action)
        handle.get_result_async().add_done_callback(self._on_result)

    def _on_feedback(self, message: Explore.Impl.FeedbackMessage) -> None:
        self.status = message.feedback.status
        self._on_progress()

    def _on_result(self, future: Future) -> None:
        if self.result is not None:
            return  # another answer
        ended = future.result()
        status: ExplorationStatus = ended.result.status
        if ended.status == GoalStatus.STATUS_UNKNOWN:
            status.reason = 'the explorer was started again, and does not know the exploration'
        end_ns = messages.stamp_ns(status.header.stamp)
        self.result = {
            'finished': ended.status == GoalStatus.STATUS_SUCCEEDED
            and status.reason_code != ExplorationStatus.BUDGET_EXHAUSTED,
            'reason': status.reason,
            'start_ns': end_ns - round(1e9 * messages.seconds(status.elapsed)),
            'end_ns': end_ns,
        }
        self.status = status
        self._on_progress()


_COMMAND_TIMEOUT_NS = 500_000_000


class RobotInterface:
    """A simulated robot on the graph; its topics begin with a prefix, '' or 'robot1/'.

    Commands in; what the robot senses, and the ground truth, out.
    """

    def __init__(
        self,
        node: Node,
        prefix: str,
        simulation: Simulation,
        diagnostics: NodeDiagnostics,
        publish_tf: bool,
    ) -> None:
        """publish_tf: whether odom -> base_link and base_link -> laser are published."""
        self._prefix = prefix
        self._simulation = simulation
        self._diagnostics = diagnostics
        lasers = simulation.lasers
        self._scan_time_s = 1.0 / lasers[0].config.scan_rate_hz
        self._mounts = [laser.mount for laser in lasers]
        self._scans = {
            mount.frame: node.create_publisher(LaserScan, f'{prefix}{mount.topic}', qos.STREAM)
            for mount in self._mounts
        }
        self._odom = node.create_publisher(Odometry, f'{prefix}odom', qos.STREAM)
        self._truth = node.create_publisher(PoseStamped, f'{prefix}ground_truth', qos.STREAM)
        self._collisions = node.create_publisher(UInt32, f'{prefix}collisions', qos.LATCHED)
        # Frames of several robots have the same names: each robot has transforms of its own.
        below = prefix or '/'
        self._tf = node.create_publisher(TFMessage, f'{below}tf', qos.STREAM)
        self._tf_static = node.create_publisher(
            TFMessage, f'{below}tf_static', qos.STATIC_TRANSFORMS
        )
        self._publish_tf = publish_tf
        self._last_collisions = -1
        self._last_scans: list[LaserScan] = []
        self._command = (0.0, 0.0)  # m/s and rad/s
        self._command_ns = 0
        VelocitySubscription(node, diagnostics, self._on_command, f'{prefix}{COMMANDS}')
        self._teleports = f'~/{prefix}set_pose'
        node.create_subscription(PoseStamped, self._teleports, self._on_teleport, qos.STREAM)
        if publish_tf:
            self._publish_laser_poses()

    @property
    def scan_subscribers(self) -> int:
        """Number of subscribers of the scans; of several lasers, of the one that has the fewest."""
        return min(int(scans.get_subscription_count()) for scans in self._scans.values())

    def move(self) -> None:
        """Drive for one step as commanded; as robots, it stops without a recent command."""
        is_recent = self._simulation.stamp_ns - self._command_ns <= _COMMAND_TIMEOUT_NS
        self._simulation.move(*(self._command if is_recent else (0.0, 0.0)))

    def publish(self) -> bool:
        """Publish the present sensor readings, the scans last; returns whether there was one."""
        moment = self._simulation.read_sensors()
        robot = self._simulation.robot
        self._publish_odometry(moment)
        truth = messages.pose_stamped_msg(robot.T_world_base, 'world', moment.stamp_ns)
        self._truth.publish(truth)
        if robot.collisions != self._last_collisions:
            self._last_collisions = robot.collisions
            self._collisions.publish(UInt32(data=robot.collisions))
        if moment.scans:
            self._last_scans = [
                messages.scan_msg(scan, scan.frame, self._scan_time_s) for scan in moment.scans
            ]
            self._publish_scans()
        return bool(moment.scans)

    def repeat_scan(self) -> None:
        """Publish the last scan again, with the present odometry."""
        if self._last_scans:
            self._publish_scans()
            self._publish_odometry(self._simulation.read_sensors())

    def _publish_laser_poses(self) -> None:
        transforms = [
            messages.transform_msg(mount.T_base_laser, 'base_link', mount.frame, 0)
            for mount in self._mounts
        ]
        self._tf_static.publish(TFMessage(transforms=transforms))

    def _publish_scans(self) -> None:
        for message in self._last_scans:
            self._scans[message.header.frame_id].publish(message)

    def _publish_odometry(self, moment: SensorReadings) -> None:
        robot = self._simulation.robot
        frames = ('odom', 'base_link')
        self._odom.publish(
            messages.odometry_msg(moment.T_odom_base, (robot.v, robot.w), frames, moment.stamp_ns)
        )
        if self._publish_tf:
            transform = messages.transform_msg(moment.T_odom_base, *frames, moment.stamp_ns)
            self._tf.publish(TFMessage(transforms=[transform]))

    def _on_command(self, v: float, w: float) -> None:
        if not np.isfinite((v, w)).all():
            reason = f'command {(v, w)}: expected finite numbers'
            self._diagnostics.message_rejected(f'{self._prefix}{COMMANDS}', reason)
            return
        self._command = (v, w)
        self._command_ns = self._simulation.stamp_ns

    def _on_teleport(self, message: PoseStamped) -> None:
        """Teleport the robot, for kidnapping tests: the odometry does not change."""
        self._diagnostics.message_received(self._teleports)
        try:
            self._simulation.teleport(messages.pose_from_msg(message.pose))
        except InputError as error:
            self._diagnostics.message_rejected(self._teleports, str(error))


def robot_starts(
    world: World, file: Path, count: int, given: tuple[str, str], radius_m: float
) -> list[Array]:
    """Start (3,) of each robot of a radius: as given, as in the file of the world, or side by side.

    file: of the world; given: the parameters start and starts.
    Raises ConfigError where these are wrong, InputError where there is no room.
    """
    start, starts = given
    if start and starts:
        raise ConfigError('start and starts: expected one of the two')
    if starts:
        poses = poses_from('starts', starts)
        if len(poses) != count:
            raise ConfigError(
                f'starts = {quoted(starts)}: expected as many as robots ({count}), found '
                f'{len(poses)}'
            )
        return poses
    if start:
        return starts_side_by_side(world, _parsed('start', start), count, radius_m)
    listed = read_starts(file)
    if not se2.is_finite(world.start) and not len(listed) >= count > 1:
        raise ConfigError(f'start: world {world.name} has none: expected "x,y,theta"')
    return starts_in(world, world.start, listed, count, radius_m)


def poses_from(name: str, text: str) -> list[Array]:
    """Poses (3,) of a parameter like "x,y,theta; x,y,theta". Raises ConfigError."""
    return [_parsed(name, part) for part in text.split(';')]


def _parsed(name: str, text: str) -> Array:
    return parse_pose(text, name, 'x,y,theta')
