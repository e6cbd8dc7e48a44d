"""Navigation: goals in, velocity commands out, by A* on the graph and wavefront on the map."""

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav2_msgs.action import NavigateThroughPoses, NavigateToPose
from nav_msgs.msg import Path
from rclpy.action import ActionClient
from sensor_msgs.msg import LaserScan

from thinmap_msgs.msg import KeepOut, SlamStatus, TopologicalMap
from thinmap_ros import kernels
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.planning.navigator import (
    CONTROL_PERIOD_S,
    Command,
    Navigator,
    NavigatorConfig,
)
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.topology.graph import topology_from_msg
from thinmap_ros.logs import decode
from thinmap_ros.logs.frames import NONE
from thinmap_ros.nodes.parts.driving import (
    BaseWatch,
    ErrorCode,
    MapInput,
    MapTimeoutConfig,
    NavigationTask,
    RobotState,
    TaskReader,
    TeamDriving,
)
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.action_server import Outcome, SingleGoalServer
from thinmap_ros.ros.diagnostics import ERROR, OK, WARN
from thinmap_ros.ros.laser_transform import LaserTransform
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.stop_topic import StopTopic
from thinmap_ros.ros.subscription import WARN_PERIOD_S, subscribe_all, subscribe_guarded
from thinmap_ros.ros.tf import OdometrySource
from thinmap_ros.ros.time_jumps import STEADY
from thinmap_ros.ros.velocity import VelocityPublisher, declare_stamped

# As in Nav2, there is no estimate of the remaining time below this speed or distance.
_MIN_SPEED_M_S = 0.01
_MIN_DISTANCE_M = 0.1
_MAX_INT16 = 2**15 - 1
# Nodes and edges, which are read in a part of a control period: about 50,000 m2 of a building.
_MAX_TOPOLOGY_SIZE = 4_000
_POSE_FAULTS = {
    SlamStatus.LOST: 'lost (the place of the robot in the map is unknown)',
    SlamStatus.BLIND: 'laser blind (it does not confirm the pose)',
    SlamStatus.MISALIGNED: 'laser misaligned (turned on the robot)',
    SlamStatus.NO_MAP: 'the localizer has no map',
}
_LOOK_PERIOD_S = 0.25  # without a goal
# A base that was told to drive by a node that is gone drives on: stops of a second after each new
# subscription of cmd_vel, which may discover this node later than it is discovered.
_STOPS = round(1.0 / CONTROL_PERIOD_S)


class _NavigatorPublishers:
    """Publishes velocity commands and the planned path.

    velocity: what is commanded; base: whether the robot moves as commanded.
    """

    def __init__(self, node: ThinmapNode, map_frame: str, base_frame: str, base: BaseWatch) -> None:
        self.map_frame = map_frame
        self.base = base
        self._subscribers = 0
        self._stops = 0
        self._node = node
        self.velocity = VelocityPublisher(node, base_frame, declare_stamped(node))
        self._plan = node.create_publisher(Path, 'plan', qos.LATCHED)
        self._published_path: Array | None = None
        self.is_moving = False  # by the last command

    def command(self, v: float, w: float) -> None:
        self.velocity.publish(v, w)
        self.base.add_sent(v, w)
        self.is_moving = v != 0.0 or w != 0.0

    @property
    def has_to_stand(self) -> bool:
        """Whether a base has come, or moves."""
        return self.base.subscribers != self._subscribers or self.base.supervisor.is_creeping

    def stand(self) -> bool:
        """Without a goal, tell to stand who has just subscribed, and a base that moves.

        Returns whether there was one.
        """
        count = self.base.subscribers
        if count > self._subscribers and (self._subscribers == 0 or self.base.is_obeyed):
            self._stops = _STOPS
        self._subscribers = count
        if self._stops > 0 or self.base.supervisor.is_creeping:
            self._stops -= self._stops > 0
            self.command(0.0, 0.0)
            return True
        return False

    def plan(self, path: Array | None) -> None:
        """Publish a path (K, 2), unless it is the one that was published last."""
        if path is not None and path is not self._published_path:
            self._published_path = path
            self._plan.publish(messages.path_msg(path, self.map_frame, self._node.now_ns))


class NavigatorNode(ThinmapNode):
    """/pose, /scan, odometry, /tf and the maps in; /cmd_vel and /plan out.

    Actions navigate_to_pose and navigate_through_poses, as Nav2's: one goal at a time, a newer one
    replaces it. /goal_pose sends a goal to navigate_to_pose. Goals in other frames than the map's
    are transformed when they arrive. Where somebody publishes /topology, distant goals are planned
    on it. While any publisher of /stop says true, or is gone after it did, the robot stands, and
    all goals are aborted: ~/release_stop. It does not drive into areas of /keep_out, and aborts
    goals inside; a robot that is in one may leave it.

    With team: true it plans over the ground that the other robots of /team/tiles know, too, and
    gives way to those of /team/claims.
    """

    def __init__(self) -> None:
        super().__init__('navigator')
        self._config = parameters.declare_config(self, NavigatorConfig, self._on_config)
        map_frame = parameters.declare_map_frame(self)
        self._laser_transform = LaserTransform(self)
        base_frame = self._laser_transform.base_frame
        base = BaseWatch(self, self._config)
        self._output = _NavigatorPublishers(self, map_frame, base_frame, base)
        timeout_s = parameters.declare_config(self, MapTimeoutConfig).map_timeout_s
        self._map = MapInput(self.elapsed_time, timeout_s)
        self._tasks = TaskReader(self, map_frame, self._map)
        self._odometry = OdometrySource(self, base_frame, self._on_odometry)
        self._team = TeamDriving(self)
        parameters.reject_unknown(self)
        kernels.navigator()
        self.reset_state()
        self._odometry.subscribe()
        subscribe_guarded(self, PoseWithCovarianceStamped, 'pose', self._on_pose, qos.STREAM)
        self._laser_transform.subscribe(self, self._on_scan)
        subscribe_guarded(self, SlamStatus, 'slam_status', self._on_slam_status, qos.STREAM)
        self._map.subscribe(self)
        subscribe_all(
            self,
            (KeepOut, 'keep_out', self._on_keep_out, qos.LATCHED),
            (TopologicalMap, 'topology', self._on_topology, qos.LATCHED),
            (PoseStamped, 'goal_pose', self._on_goal_pose, qos.STREAM),
        )
        self._goals = SingleGoalServer(
            self,
            NavigateToPose,
            'navigate_to_pose',
            self._on_task,
            self._preempted,
            self._tasks.to_pose,
        )
        self._goals.add_action(
            NavigateThroughPoses, 'navigate_through_poses', self._tasks.through_poses
        )
        # As in Nav2, a goal from RViz is one of the action: its status is public.
        self._own_client = ActionClient(self, NavigateToPose, 'navigate_to_pose')
        self._check_inputs()
        self._stop_topic = StopTopic(self, self._on_stop)
        self._timer = self.create_active_timer(CONTROL_PERIOD_S, self._control)
        self.create_active_timer(_LOOK_PERIOD_S, self._look, clock=STEADY)

    def _check_inputs(self) -> None:
        """Report a mapper that is silent; drive neither by two poses nor by two maps."""
        self.diagnostics.add_check(
            WARN, lambda: '' if self._robot.stop_reason() else self._map.warning
        )
        for topic, is_heard in (
            ('pose', lambda: self._robot.has_two_localizers()),
            ('local_grid', self._map.has_two_mappers),
        ):
            self.diagnostics.check_sole_publisher(topic, ERROR, is_heard)

    def reset_state(self) -> None:
        """Discard the map, the graph and the pose of the robot."""
        self._odometry.reset()
        self._tasks.reset()
        self._navigator = Navigator(self._config)
        self._map.reset()
        self._output.base.supervisor.release()
        self._robot = RobotState(
            self.elapsed_time, self._odometry.source != NONE, self._laser_transform.scan_topics
        )
        self._task = NavigationTask(NavigateToPose, (), 0)

    def _on_config(self, config: NavigatorConfig) -> None:
        """Continue with other parameters: to the same goal, on a new path."""
        remaining = self._navigator.waypoints_remaining + 1
        self._config = config
        topology = self._navigator.topology
        self._navigator = Navigator(config)
        self._navigator.topology = topology
        self._output.base.supervisor.set_config(config)
        if self._goals.active:
            self._drive_to(self._task.poses[-remaining:])

    def stop(self) -> None:
        """End the goal; the robot stops."""
        self._end(Outcome.ABORTED, ErrorCode.UNKNOWN, 'navigator deactivated or reset')

    def close(self) -> None:
        """Stop the robot: the last thing the node does."""
        self._output.velocity.stop()
        super().close()

    def _on_odometry(self, stamp_ns: int, T_odom_base: Array) -> None:
        self._robot.add_odometry(stamp_ns, T_odom_base)
        if not self._robot.odometry_fault:
            self._output.base.add_odometry(stamp_ns, T_odom_base)

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        T_map_base = messages.pose_from_msg(message.pose.pose)
        self._robot.add_pose(messages.stamp_ns(message.header.stamp), T_map_base)

    def _on_scan(self, topic: str, message: LaserScan) -> None:
        scan = self._laser_transform.to_scan(topic, message)
        self._odometry.add_scan_stamp(scan.odometry_ns)
        self._robot.add_scan(scan, topic)

    def _on_slam_status(self, message: SlamStatus) -> None:
        self._robot.pose_fault = _POSE_FAULTS.get(message.state, '')
        self._map.pose_map_id = message.map_id

    def _on_topology(self, message: TopologicalMap) -> None:
        size = len(message.node_ids) + len(message.edge_ids)
        if size > _MAX_TOPOLOGY_SIZE:
            self._navigator.topology = None
            raise InputError(
                f'topology of {size} nodes and edges: expected at most {_MAX_TOPOLOGY_SIZE}: '
                'distant goals are planned without it'
            )
        self._navigator.topology = topology_from_msg(message)

    def _on_keep_out(self, message: KeepOut) -> None:
        self._map.keep_out = decode.keep_out(message)
        if not self._goals.active:
            return
        try:
            self._tasks.require_open(self._task.poses[-self._navigator.waypoints_remaining - 1 :])
        except InputError as error:
            self._end(Outcome.ABORTED, ErrorCode.UNKNOWN, str(error))

    def _on_stop(self, stop: StopTopic) -> None:
        if self._tasks.stop_reason and not stop.reason:
            self._output.base.supervisor.release()
        self._tasks.stop_reason = stop.reason
        self._output.velocity.hold(bool(stop.reason))
        if stop.reason:
            self._end(Outcome.ABORTED, ErrorCode.UNKNOWN, stop.reason)
        else:
            self.diagnostics.set_state(OK, 'released')

    def _on_goal_pose(self, message: PoseStamped) -> None:
        self._tasks.pose(message)  # raises for an invalid one, which is counted
        self._own_client.send_goal_async(NavigateToPose.Goal(pose=message))

    def _on_task(self, task: NavigationTask) -> None:
        self._timer.reset()
        self._task = task
        self._drive_to(task.poses)

    def _drive_to(self, poses: tuple[Array, ...]) -> None:
        """Set poses (3,) as goal; the heading matters at the last one."""
        x, y, theta = poses[-1].tolist()
        waypoints = [(float(pose[0]), float(pose[1])) for pose in poses[:-1]]
        self._navigator.set_goal(x, y, theta, waypoints=waypoints)

    def _preempted(self) -> NavigateToPose.Result:
        # As in Nav2, an aborted goal without an error code was replaced.
        is_canceled = self._goals.is_cancel_requested
        reason = 'cancelled' if is_canceled else 'replaced by a newer goal'
        return self._task.result(ErrorCode.NONE, reason)

    def _look(self) -> None:
        if self._timer.is_canceled() and self._output.has_to_stand:
            self._timer.reset()

    def _control(self) -> None:
        if not self._goals.active:
            if not self._output.stand():
                self._timer.cancel()  # until there is a goal
            return
        if self._goals.is_cancel_requested:
            self._end(Outcome.CANCELED, ErrorCode.NONE, 'cancelled')
            return
        if fault := self._output.base.fault:
            self._end(Outcome.ABORTED, ErrorCode.UNKNOWN, fault)
            return
        if self._output.velocity.is_interrupted:
            self._navigator.reset_velocity()
        command = self._command()
        if command is None:
            self._publish_feedback(0.0)
            return
        self._output.command(command.v, command.w)
        self._output.plan(self._navigator.path)
        if command.state == 'reached':
            self._end(Outcome.SUCCEEDED, ErrorCode.NONE, '')
        elif command.state == 'failed':
            code = ErrorCode.TIMEOUT if command.is_timeout else ErrorCode.UNKNOWN
            self._end(Outcome.ABORTED, code, command.reason)
        else:
            self._publish_feedback(command.v)

    def _command(self) -> Command | None:
        """The command of the navigator; a stop while the laser is silent.

        None before all inputs are received.
        """
        if fault := self._robot.stop_reason() or self._map.fault or self.diagnostics.error:
            return self._stand(fault)
        patch = self._map.patch
        T_map_base = self._robot.pose()
        awaited = self._robot.awaited
        if patch is None or T_map_base is None or awaited:
            missing = [*awaited, *([] if patch else ['map'])]
            self.get_logger().warning(
                f'goal waits: no {", ".join(missing)} yet',
                throttle_duration_sec=WARN_PERIOD_S,
            )
            return None
        self.diagnostics.set_state(OK, 'driving')
        with self.diagnostics.time_step('navigator'):
            patch = self._map.keep_out.laid_on(self._team.completed(patch), T_map_base)
            command = self._navigator.step(T_map_base, patch, self._robot.scans, CONTROL_PERIOD_S)
            return self._team.allowed(self._navigator, T_map_base, command, CONTROL_PERIOD_S)

    def _stand(self, fault: str) -> Command:
        """The command of a protective stop; a robot that stands waits in any case."""
        reason = f'{fault}: standing still'
        self.get_logger().warning(reason, throttle_duration_sec=WARN_PERIOD_S)
        self.diagnostics.set_state(WARN, reason)
        self._navigator.reset_velocity()
        if self._config.resume_after_stop or not self._output.is_moving:
            return Command(0.0, 0.0, 'blocked', reason)
        self._stop_topic.hold()
        return Command(0.0, 0.0, 'failed', f'{reason} until it is released: ~/release_stop')

    def _publish_feedback(self, speed_m_s: float) -> None:
        """Publish feedback; current_pose has no frame while the pose is unknown."""
        remaining_m = self._navigator.distance_remaining_m
        elapsed_ns = self.elapsed_time.now_ns() - self._task.start_ns
        feedback = self._task.action.Feedback(
            navigation_time=messages.duration_msg(elapsed_ns / SECOND_NS),
            number_of_recoveries=min(self._navigator.recoveries, _MAX_INT16),
            distance_remaining=remaining_m,
        )
        T_map_base = self._robot.pose()
        if T_map_base is not None:
            frame = self._output.map_frame
            feedback.current_pose = messages.pose_stamped_msg(T_map_base, frame, self.now_ns)
        if speed_m_s > _MIN_SPEED_M_S and remaining_m > _MIN_DISTANCE_M:
            feedback.estimated_time_remaining = messages.duration_msg(remaining_m / speed_m_s)
        if self._task.action is NavigateThroughPoses:
            feedback.number_of_poses_remaining = self._navigator.waypoints_remaining + 1
        self._goals.feedback(feedback)

    def _end(self, outcome: Outcome, code: ErrorCode, reason: str) -> None:
        self._navigator.cancel()
        self.diagnostics.set_state(OK, reason or 'goal reached')
        self._output.command(0.0, 0.0)
        self._goals.finish(outcome, self._task.result(code, reason))


main = node_main.program(NavigatorNode)

if __name__ == '__main__':
    main()
