"""Driving: goals in, velocity commands out, along wavefront paths on the map."""

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from sensor_msgs.msg import LaserScan

from thinmap_msgs.action import NavigateToPose
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.map_mirror import MapMirror
from thinmap_ros.core.odometry import OdometryBuffer
from thinmap_ros.core.planning.navigator import Command, Navigator, NavigatorConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.kernels import warm_up
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.action_server import Outcome, SingleGoalServer
from thinmap_ros.ros.diagnostics import OK, WARN
from thinmap_ros.ros.laser_transform import LaserMount
from thinmap_ros.ros.lifecycle_node import LiveNode
from thinmap_ros.ros.subscription import listen

_WARN_PERIOD_S = 5.0
_CONTROL_PERIOD_S = 0.1
_SILENCE_NS = 400_000_000  # with the control period: a stop within half a second
# Without a new pose the last correction of the odometry holds for a while.
_SILENCES_NS = {'laser': _SILENCE_NS, 'odometry': _SILENCE_NS, 'localizer': 3_000_000_000}


class NavigatorNode(LiveNode):
    """/pose, /odom, /scan and the maps in; /cmd_vel and /plan out; action navigate_to_pose."""

    def __init__(self) -> None:
        super().__init__('navigator')
        self._config = parameters.declare(self, NavigatorConfig, self._on_config)
        self._map_frame = parameters.declare_value(self, 'map_frame', 'map', 'frame of the map')
        self._mount = LaserMount(self)
        parameters.check_unknown(self)
        warm_up.navigator()
        self.begin_anew()
        self._cmd_vel = self.create_publisher(Twist, 'cmd_vel', qos.STREAM)
        self._plan = self.create_publisher(Path, 'plan', qos.LATCHED)
        listen(self, Odometry, 'odom', self._on_odometry, qos.STREAM)
        listen(self, PoseWithCovarianceStamped, 'pose', self._on_pose, qos.STREAM)
        listen(self, LaserScan, 'scan', self._on_scan, qos.SENSOR)
        listen(self, OccupancyGrid, 'map', self._on_map, qos.LATCHED)
        listen(self, OccupancyGrid, 'local_map', self._on_window, qos.LATCHED)
        self._goals = SingleGoalServer(
            self, NavigateToPose, 'navigate_to_pose', self._on_goal, self._on_cancel, _preempted
        )
        self.every(_CONTROL_PERIOD_S, self._control)

    def begin_anew(self) -> None:
        """Forget the map and where the robot is."""
        self._navigator = Navigator(self._config)
        self._map = MapMirror()
        self._odometry = OdometryBuffer()
        self._T_map_odom: Array | None = None
        self._T_odom_base: Array | None = None
        self._scan: Scan | None = None
        self._is_blind = False
        self._heard_ns: dict[str, int] = {}
        self._shown_path: Array | None = None
        self._goal: tuple[float, float, float | None] = (0.0, 0.0, None)
        self._cancel_asked = False

    def _on_config(self, config: NavigatorConfig) -> None:
        """Drive on with other parameters: to the same goal, on a new path."""
        self._config = config
        self._navigator = Navigator(config)
        if self._goals.active:
            self._navigator.set_goal(*self._goal)

    def stand_still(self) -> None:
        """End the goal; the robot stops."""
        self._end(Outcome.ABORTED, 'the navigator was stopped or begins anew')

    def close(self) -> None:
        """Stop the robot: the last thing the node does."""
        self._cmd_vel.publish(messages.twist_msg(0.0, 0.0))
        super().close()

    def _on_odometry(self, message: Odometry) -> None:
        self._T_odom_base = messages.pose_from(message.pose.pose)
        self._note('odometry')
        self._odometry.add(messages.stamp_ns(message.header.stamp), self._T_odom_base)

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        T_odom_base = self._odometry.interpolate(messages.stamp_ns(message.header.stamp))
        if T_odom_base is None:
            return
        T_map_base = messages.pose_from(message.pose.pose)
        self._note('localizer')
        self._T_map_odom = se2.compose(T_map_base, se2.invert(T_odom_base))

    def _on_scan(self, message: LaserScan) -> None:
        scan = self._mount.scan(message)
        self._is_blind = scan.is_blind
        if not scan.is_blind:
            self._scan = scan
            self._note('laser')

    def _on_map(self, message: OccupancyGrid) -> None:
        self._map.replace(messages.patch_from(message))

    def _on_window(self, message: OccupancyGrid) -> None:
        self._map.paste(messages.patch_from(message))

    def _on_goal(self, request: NavigateToPose.Goal) -> None:
        try:
            goal = messages.pose_from(request.pose.pose)
        except InputError as error:
            self._end(Outcome.ABORTED, f'goal: {error}')
            return
        if request.pose.header.frame_id not in ('', self._map_frame):
            reason = f'goal in frame "{request.pose.header.frame_id}": expected "{self._map_frame}"'
            self._end(Outcome.ABORTED, reason)
            return
        self._cancel_asked = False
        self._goal = (
            float(goal[0]),
            float(goal[1]),
            float(goal[2]) if request.use_heading else None,
        )
        self._navigator.set_goal(*self._goal)

    def _on_cancel(self) -> None:
        self._cancel_asked = True

    def _control(self) -> None:
        if not self._goals.active:
            return
        if self._cancel_asked:
            self._end(Outcome.CANCELED, 'cancelled')
            return
        command = self._command()
        if command is None:
            self._tell('waiting')
            return
        self._cmd_vel.publish(messages.twist_msg(command.v, command.w))
        self._show_path()
        if command.state == 'reached':
            self._end(Outcome.SUCCEEDED, 'goal reached')
        elif command.state == 'failed':
            self._end(Outcome.ABORTED, command.reason)
        else:
            self._tell(command.state)

    def _command(self) -> Command | None:
        """What the navigator says now; a stop while the laser is silent.

        None before everything is known.
        """
        if fault := self._fault():
            reason = f'{fault}: standing still'
            self.get_logger().warning(reason, throttle_duration_sec=_WARN_PERIOD_S)
            self.health.state(WARN, reason)
            self._navigator.reset_velocity()
            return Command(0.0, 0.0, 'blocked', reason)
        if (
            self._map.patch is None
            or self._scan is None
            or self._T_map_odom is None
            or self._T_odom_base is None
        ):
            self.get_logger().warning(
                'goal waits: no map, scan, pose or odometry yet',
                throttle_duration_sec=_WARN_PERIOD_S,
            )
            return None
        self.health.state(OK, 'driving')
        T_map_base = se2.compose(self._T_map_odom, self._T_odom_base)
        with self.health.timed('navigator'):
            return self._navigator.step(T_map_base, self._map.patch, self._scan, _CONTROL_PERIOD_S)

    def _fault(self) -> str:
        """Why driving on would be driving blind; '' where all is well."""
        if self._is_blind:
            return 'laser blind (too few valid beams)'
        latest = self._odometry.latest_stamp_ns
        if (
            latest is not None
            and self._scan is not None
            and latest - self._scan.stamp_ns > _SILENCE_NS
        ):
            return 'laser silent'
        now_ns = self.get_clock().now().nanoseconds
        for who, limit_ns in _SILENCES_NS.items():
            if now_ns - self._heard_ns.get(who, now_ns) > limit_ns:
                return f'{who} silent'
        return ''

    def _note(self, who: str) -> None:
        self._heard_ns[who] = self.get_clock().now().nanoseconds

    def _show_path(self) -> None:
        path = self._navigator.path
        if path is not None and path is not self._shown_path:
            self._shown_path = path
            ns = self.get_clock().now().nanoseconds
            self._plan.publish(messages.path_msg(np.asarray(path), self._map_frame, ns))

    def _tell(self, state: str) -> None:
        feedback = NavigateToPose.Feedback()
        feedback.state = state
        feedback.distance_remaining_m = self._navigator.distance_remaining_m
        self._goals.feedback(feedback)

    def _end(self, outcome: Outcome, reason: str) -> None:
        self._navigator.cancel()
        self.health.state(OK, reason)
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
