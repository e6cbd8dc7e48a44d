"""Navigation: goals in, velocity commands out, along wavefront paths on the map."""

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.clock import Clock
from sensor_msgs.msg import LaserScan

from thinmap_msgs.action import NavigateToPose
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.map_mirror import MapMirror
from thinmap_ros.core.odometry import OdometryBuffer
from thinmap_ros.core.planning.navigator import (
    CONTROL_PERIOD_S,
    SENSOR_TIMEOUT_NS,
    Command,
    Navigator,
    NavigatorConfig,
)
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.kernels import warm_up
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.action_server import Outcome, SingleGoalServer
from thinmap_ros.ros.diagnostics import OK, WARN
from thinmap_ros.ros.laser_transform import LaserTransform
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import WARN_PERIOD_S, subscribe_guarded

# Without a new pose the last correction of the odometry holds for a while.
_TIMEOUTS_NS = {
    'laser': SENSOR_TIMEOUT_NS,
    'odometry': SENSOR_TIMEOUT_NS,
    'localizer': 3_000_000_000,
}


class _RobotState:
    """Pose and view of the robot, by the last scan, odometry and pose received.

    scan: the last one that is not blind.
    """

    def __init__(self, clock: Clock) -> None:
        self.scan: Scan | None = None
        self._clock = clock
        self._is_blind = False
        self._odometry = OdometryBuffer()
        self._T_map_odom: Array | None = None
        self._T_odom_base: Array | None = None
        self._received_ns: dict[str, int] = {}

    def add_odometry(self, stamp_ns: int, T_odom_base: Array) -> None:
        self._T_odom_base = T_odom_base
        self._record_time('odometry')
        self._odometry.add(stamp_ns, T_odom_base)

    def add_pose(self, stamp_ns: int, T_map_base: Array) -> None:
        T_odom_base = self._odometry.interpolate(stamp_ns)
        if T_odom_base is not None:
            self._record_time('localizer')
            self._T_map_odom = se2.compose(T_map_base, se2.invert(T_odom_base))

    def add_scan(self, scan: Scan) -> None:
        self._is_blind = scan.is_blind
        if not scan.is_blind:
            self.scan = scan
            self._record_time('laser')

    def pose(self) -> Array | None:
        """T_map_base (3,) now; None before a pose and odometry are received."""
        if self._T_map_odom is None or self._T_odom_base is None:
            return None
        return se2.compose(self._T_map_odom, self._T_odom_base)

    def stop_reason(self) -> str:
        """Why the robot must not drive on; '' for no reason."""
        if self._is_blind:
            return 'laser blind (too few valid beams)'
        if self._scan_age_ns() > SENSOR_TIMEOUT_NS:
            return 'laser silent'
        now_ns = self._clock.now().nanoseconds
        for source, limit_ns in _TIMEOUTS_NS.items():
            if now_ns - self._received_ns.get(source, now_ns) > limit_ns:
                return f'{source} silent'
        return ''

    def _scan_age_ns(self) -> int:
        """Time from the last scan to the last odometry, by their stamps; 0 without both."""
        latest_ns = self._odometry.latest_stamp_ns
        return 0 if self.scan is None or latest_ns is None else latest_ns - self.scan.stamp_ns

    def _record_time(self, source: str) -> None:
        self._received_ns[source] = self._clock.now().nanoseconds


class NavigatorNode(ThinmapNode):
    """/pose, /odom, /scan and the maps in; /cmd_vel and /plan out; action navigate_to_pose."""

    def __init__(self) -> None:
        super().__init__('navigator')
        self._config = parameters.declare_config(self, NavigatorConfig, self._on_config)
        self._map_frame = parameters.declare_map_frame(self)
        self._laser_transform = LaserTransform(self)
        parameters.reject_unknown(self)
        warm_up.navigator()
        self.reset_state()
        self._cmd_vel = self.create_publisher(Twist, 'cmd_vel', qos.STREAM)
        self._plan = self.create_publisher(Path, 'plan', qos.LATCHED)
        subscribe_guarded(self, Odometry, 'odom', self._on_odometry, qos.STREAM)
        subscribe_guarded(self, PoseWithCovarianceStamped, 'pose', self._on_pose, qos.STREAM)
        subscribe_guarded(self, LaserScan, 'scan', self._on_scan, qos.SENSOR)
        subscribe_guarded(self, OccupancyGrid, 'map', self._on_map, qos.LATCHED)
        subscribe_guarded(self, OccupancyGrid, 'local_map', self._on_window, qos.LATCHED)
        self._goals = SingleGoalServer(
            self, NavigateToPose, 'navigate_to_pose', self._on_goal, self._on_cancel, _preempted
        )
        self.create_active_timer(CONTROL_PERIOD_S, self._control)

    def reset_state(self) -> None:
        """Discard the map and the pose of the robot."""
        self._navigator = Navigator(self._config)
        self._map = MapMirror()
        self._robot = _RobotState(self.get_clock())
        self._published_path: Array | None = None
        self._goal: tuple[float, float, float | None] = (0.0, 0.0, None)
        self._is_canceled = False

    def _on_config(self, config: NavigatorConfig) -> None:
        """Continue with other parameters: to the same goal, on a new path."""
        self._config = config
        self._navigator = Navigator(config)
        if self._goals.active:
            self._navigator.set_goal(*self._goal)

    def stop(self) -> None:
        """End the goal; the robot stops."""
        self._end(Outcome.ABORTED, 'navigator deactivated or reset')

    def close(self) -> None:
        """Stop the robot: the last thing the node does."""
        self._cmd_vel.publish(messages.twist_msg(0.0, 0.0))
        super().close()

    def _on_odometry(self, message: Odometry) -> None:
        T_odom_base = messages.pose_from_msg(message.pose.pose)
        self._robot.add_odometry(messages.stamp_ns(message.header.stamp), T_odom_base)

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        T_map_base = messages.pose_from_msg(message.pose.pose)
        self._robot.add_pose(messages.stamp_ns(message.header.stamp), T_map_base)

    def _on_scan(self, message: LaserScan) -> None:
        self._robot.add_scan(self._laser_transform.to_scan(message))

    def _on_map(self, message: OccupancyGrid) -> None:
        self._map.replace(messages.grid_from_msg(message))

    def _on_window(self, message: OccupancyGrid) -> None:
        self._map.paste(messages.grid_from_msg(message))

    def _on_goal(self, request: NavigateToPose.Goal) -> None:
        try:
            goal = messages.pose_from_msg(request.pose.pose)
        except InputError as error:
            self._end(Outcome.ABORTED, f'goal: {error}')
            return
        if request.pose.header.frame_id not in ('', self._map_frame):
            reason = f'goal in frame "{request.pose.header.frame_id}": expected "{self._map_frame}"'
            self._end(Outcome.ABORTED, reason)
            return
        self._is_canceled = False
        self._goal = (
            float(goal[0]),
            float(goal[1]),
            float(goal[2]) if request.use_heading else None,
        )
        self._navigator.set_goal(*self._goal)

    def _on_cancel(self) -> None:
        self._is_canceled = True

    def _control(self) -> None:
        if not self._goals.active:
            return
        if self._is_canceled:
            self._end(Outcome.CANCELED, 'cancelled')
            return
        command = self._command()
        if command is None:
            self._publish_feedback('waiting')
            return
        self._cmd_vel.publish(messages.twist_msg(command.v, command.w))
        self._publish_plan()
        if command.state == 'reached':
            self._end(Outcome.SUCCEEDED, 'goal reached')
        elif command.state == 'failed':
            self._end(Outcome.ABORTED, command.reason)
        else:
            self._publish_feedback(command.state)

    def _command(self) -> Command | None:
        """The command of the navigator; a stop while the laser is silent.

        None before all inputs are received.
        """
        if fault := self._robot.stop_reason():
            reason = f'{fault}: standing still'
            self.get_logger().warning(reason, throttle_duration_sec=WARN_PERIOD_S)
            self.diagnostics.set_state(WARN, reason)
            self._navigator.reset_velocity()
            return Command(0.0, 0.0, 'blocked', reason)
        patch = self._map.patch
        scan = self._robot.scan
        T_map_base = self._robot.pose()
        if patch is None or scan is None or T_map_base is None:
            self.get_logger().warning(
                'goal waits: no map, scan, pose or odometry yet',
                throttle_duration_sec=WARN_PERIOD_S,
            )
            return None
        self.diagnostics.set_state(OK, 'driving')
        with self.diagnostics.time_step('navigator'):
            return self._navigator.step(T_map_base, patch, scan, CONTROL_PERIOD_S)

    def _publish_plan(self) -> None:
        path = self._navigator.path
        if path is not None and path is not self._published_path:
            self._published_path = path
            ns = self.get_clock().now().nanoseconds
            self._plan.publish(messages.path_msg(np.asarray(path), self._map_frame, ns))

    def _publish_feedback(self, state: str) -> None:
        feedback = NavigateToPose.Feedback()
        feedback.state = state
        feedback.distance_remaining_m = self._navigator.distance_remaining_m
        self._goals.feedback(feedback)

    def _end(self, outcome: Outcome, reason: str) -> None:
        self._navigator.cancel()
        self.diagnostics.set_state(OK, reason)
        self._cmd_vel.publish(messages.twist_msg(0.0, 0.0))
        self._goals.finish(
            outcome, NavigateToPose.Result(success=outcome is Outcome.SUCCEEDED, reason=reason)
        )


def _preempted() -> NavigateToPose.Result:
    return NavigateToPose.Result(success=False, reason='replaced by a newer goal')


def main() -> None:
    """Run the node."""
    node_main.run(NavigatorNode)


if __name__ == '__main__':
    main()
