"""Exploration: end nodes that may still move are visited until none is left."""

import math

import numpy as np
from geometry_msgs.msg import Point, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.task import Future
from sensor_msgs.msg import LaserScan

from thinmap_msgs.action import Explore, NavigateToPose
from thinmap_msgs.msg import EndNode as EndNodeMsg
from thinmap_msgs.msg import EndNodeArray, ExplorationStatus, SlamStatus, TopologicalMap
from thinmap_msgs.srv import SaveMap
from thinmap_ros.core import validation
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.explorer import Explorer, ExplorerConfig
from thinmap_ros.core.exploration.mission import Budget, Odometer, fenced
from thinmap_ros.core.exploration.strategy import Decision, EndNode
from thinmap_ros.core.grid.map_mirror import MapMirror
from thinmap_ros.core.se2 import Array, wrap
from thinmap_ros.core.stamp_matcher import StampMatcher
from thinmap_ros.files import sessions
from thinmap_ros.kernels import warm_up
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.action_server import Outcome, SingleGoalServer
from thinmap_ros.ros.laser_transform import LaserMount
from thinmap_ros.ros.lifecycle_node import LiveNode
from thinmap_ros.ros.save_folder import SaveFolder
from thinmap_ros.ros.services import answer
from thinmap_ros.ros.subscription import listen

_WARN_PERIOD_S = 5.0
_FEEDBACK_PERIOD_S = 1.0
_SILENCE_S = 60.0
_DEAF_S = 3.0
_LOST_S = 10.0
_SAME_GOAL_M = 0.1
_SAME_GOAL_RAD = 0.2
_GIVE_UP_HOME = 3


class ExplorerNode(LiveNode):
    """Maps, /topology, /pose, /scan in; navigator's goals, /end_nodes, /exploration_status out.

    Service save_exploration keeps what was learned beside the map and the graph of a session.
    """

    def __init__(self) -> None:
        super().__init__('explorer')
        # A change holds from the next goal on.
        self._config = parameters.declare(self, ExplorerConfig, self._on_config)
        self._map_frame = parameters.declare_value(self, 'map_frame', 'map', 'frame of the map')
        self._mount = LaserMount(self)
        self._session = parameters.declare_session(self)
        self._saves = SaveFolder(self)
        parameters.check_unknown(self)
        warm_up.explorer()
        self._goal_sent: Array | None = None
        self._handle: ClientGoalHandle | None = None
        self.begin_anew()
        self._make_topics()

    def begin_anew(self) -> None:
        """Forget map, graph and what was explored, or go back to the session of the start."""
        # What was learned is kept for the next goal, until an exploration is finished.
        self._learned = (
            sessions.load_exploration(self._session, self._config) if self._session else None
        )
        self._polygon = np.empty((0, 2))
        self._map = MapMirror()
        self._topology = messages.topology_from(TopologicalMap())
        self._matcher: StampMatcher[LaserScan, Array] = StampMatcher()
        self._looks: StampMatcher[tuple[LaserScan, Array], bool] = StampMatcher()
        self._hears_windows = False
        self._T_map_base: Array | None = None
        self._heard_at = self._tracked_at = self._answered_at = 0.0
        self._is_lost = False
        self._begin(Explore.Goal())
        self._state = ExplorationStatus.IDLE

    def _on_config(self, config: ExplorerConfig) -> None:
        self._config = config
        self._learned = None

    def stand_still(self) -> None:
        """End the exploration."""
        if self._goals.active:
            self._end(ExplorationStatus.CANCELLED, 'the explorer was stopped or begins anew')

    def _make_topics(self) -> None:
        self._end_nodes = self.create_publisher(EndNodeArray, 'end_nodes', qos.LATCHED)
        self._status = self.create_publisher(ExplorationStatus, 'exploration_status', qos.LATCHED)
        listen(self, TopologicalMap, 'topology', self._on_topology, qos.LATCHED)
        listen(self, OccupancyGrid, 'map', self._on_map, qos.LATCHED)
        listen(self, OccupancyGrid, 'local_map', self._on_window, qos.LATCHED)
        listen(self, PoseWithCovarianceStamped, 'pose', self._on_pose, qos.STREAM)
        listen(self, LaserScan, 'scan', self._on_scan, qos.SENSOR)
        listen(self, SlamStatus, 'slam_status', self._on_slam_status, qos.STREAM)
        self._navigator = ActionClient(self, NavigateToPose, 'navigate_to_pose')
        self._goals = SingleGoalServer(
            self, Explore, 'explore', self._on_goal, self._on_cancel, self._preempted
        )
        self.create_service(SaveMap, 'save_exploration', self._on_save)
        self.every(_FEEDBACK_PERIOD_S, self._every_second)

    def _on_goal(self, goal: Explore.Goal) -> None:
        limits = (goal.time_limit_s, goal.distance_limit_m, goal.area_limit_m2)
        try:
            corners = [c for p in goal.area.points for c in (p.x, p.y)]
            validation.require_bounded('goal: limit or corner of the area', [*limits, *corners])
        except InputError as error:
            self._begin(Explore.Goal())
            self._end(ExplorationStatus.CANCELLED, str(error))
            return
        self._begin(goal)

    def _begin(self, goal: Explore.Goal) -> None:
        self._goal = goal
        before = self._polygon
        self._polygon = np.array([[p.x, p.y] for p in goal.area.points]).reshape(-1, 2)
        # Where other walls are in the way, other things are to be seen.
        self._learned = self._learned if np.array_equal(before, self._polygon) else None
        self._explorer = self._learned = self._learned or Explorer(self._config)
        self._odometer = Odometer()
        self._budget = Budget(goal.time_limit_s, goal.distance_limit_m, goal.area_limit_m2)
        self._decision: Decision | None = None
        self._state = ExplorationStatus.EXPLORING
        self._ending = (ExplorationStatus.NONE, '')
        self._cancel_asked = False
        self._failed_homes = 0
        self._begun_at = self._heard_at = self._tracked_at = self._now()

    def _now(self) -> float:
        return float(self.get_clock().now().nanoseconds) / 1e9

    # What is heard.

    def _on_topology(self, message: TopologicalMap) -> None:
        self._topology = messages.topology_from(message)

    def _on_map(self, message: OccupancyGrid) -> None:
        self._map.replace(messages.patch_from(message))

    def _on_window(self, message: OccupancyGrid) -> None:
        self._map.paste(messages.patch_from(message))
        self._hears_windows = True
        self._look(self._looks.add_right(messages.stamp_ns(message.header.stamp), True))

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        T_map_base = messages.pose_from(message.pose.pose)
        self._take(self._matcher.add_right(messages.stamp_ns(message.header.stamp), T_map_base))

    def _on_scan(self, message: LaserScan) -> None:
        if self._mount.scan(message).is_blind:
            return  # as good as silent: what lies in its field of view was not looked at
        self._heard_at = self._now()
        self._take(self._matcher.add_left(messages.stamp_ns(message.header.stamp), message))

    def _on_slam_status(self, message: SlamStatus) -> None:
        # Silence is none of it: a localizer that is started again goes on from where it was.
        if message.state != SlamStatus.LOST or not self._is_lost:
            self._tracked_at = self._now()
        self._is_lost = message.state == SlamStatus.LOST

    def _on_cancel(self) -> None:
        self._cancel_asked = True

    def _on_save(self, request: SaveMap.Request, response: SaveMap.Response) -> SaveMap.Response:
        def save() -> str:
            path = self._saves.inside(request.path)
            return f'saved {sessions.save_exploration(path, self._explorer)}'

        return answer(response, save)

    # What is done.

    def _take(self, pair: tuple[LaserScan, Array] | None) -> None:
        if pair is None:
            return
        if not self._hears_windows:
            self._look((pair, True))
            return
        # What a scan shows is in its window, which may come much later: a look at an older map
        # shows nothing new.
        self._look(self._looks.add_left(messages.stamp_ns(pair[0].header.stamp), pair))

    def _look(self, complete: tuple[tuple[LaserScan, Array], bool] | None) -> None:
        """Go on with a scan, made at a pose, that is in the map now."""
        if complete is None:
            return
        message, self._T_map_base = complete[0]
        if not self._goals.active or self._map.patch is None:
            return
        self._odometer.add(self._T_map_base)
        if self._state != ExplorationStatus.EXPLORING:
            return
        scan = self._mount.scan(message)
        patch = (
            self._map.patch if len(self._polygon) < 3 else fenced(self._map.patch, self._polygon)
        )
        with self.health.timed('explorer'):
            self._decision = self._explorer.step(self._topology, patch, scan, self._T_map_base)
        self._publish_end_nodes(self._decision, message)
        if self._decision.finished:
            self._conclude(int(self._decision.code), self._decision.reason)
        elif self._decision.target is not None:
            self._drive_to(self._decision.target.goal)

    def _every_second(self) -> None:
        if not self._goals.active:
            return
        now = self._now()
        if self._cancel_asked:
            self._end(ExplorationStatus.CANCELLED, 'cancelled')
            return
        if now - self._heard_at > _SILENCE_S:
            self._end(
                ExplorationStatus.SENSOR_SILENT,
                f'no scan that shows anything for {_SILENCE_S:.0f} s',
            )
            return
        if self._is_lost and now - self._tracked_at > _LOST_S:
            self._end(
                ExplorationStatus.LOCALIZATION_LOST, f'the pose has been lost for {_LOST_S:.0f} s'
            )
            return
        self._ask_again(now)
        area = 0.0 if self._decision is None else self._decision.known_area_m2
        used_up = self._budget.used_up(now - self._begun_at, self._odometer.distance_m, area)
        if used_up and self._state == ExplorationStatus.EXPLORING:
            self._conclude(ExplorationStatus.BUDGET, used_up)
        status = self._status_msg()
        self._status.publish(status)
        self._goals.feedback(Explore.Feedback(status=status, end_nodes=self._end_nodes_msg()))

    def _conclude(self, code: int, reason: str) -> None:
        """Exploring is over; what is left is the way home, if that was asked for."""
        self._ending = (code, reason)
        if self._goal.return_home and self._odometer.start is not None:
            self._state = ExplorationStatus.RETURNING
            self._drive_to(self._odometer.start)
        else:
            self._end(code, reason)

    def _end(self, code: int, reason: str) -> None:
        if self._handle is not None:
            self._handle.cancel_goal_async()
        self._handle = self._goal_sent = None
        self._ending = (code, reason)
        self._state = ExplorationStatus.FINISHED
        if code in (ExplorationStatus.ALL_RESOLVED, ExplorationStatus.NOTHING_REACHABLE):
            self._learned = None
        status = self._status_msg()
        self._status.publish(status)
        good = code in (
            ExplorationStatus.ALL_RESOLVED,
            ExplorationStatus.BUDGET,
            ExplorationStatus.NOTHING_REACHABLE,
        )
        outcome = Outcome.SUCCEEDED if good else Outcome.ABORTED
        outcome = Outcome.CANCELED if code == ExplorationStatus.CANCELLED else outcome
        self.get_logger().info(f'finished: {reason}')
        self._goals.finish(outcome, Explore.Result(status=status))

    def _preempted(self) -> Explore.Result:
        self._ending = (ExplorationStatus.CANCELLED, 'replaced by a newer goal')
        return Explore.Result(status=self._status_msg())

    # Driving, by the navigator.

    def _drive_to(self, goal: Array) -> None:
        if self._goal_sent is not None:
            near = math.dist(goal[:2], self._goal_sent[:2]) <= _SAME_GOAL_M
            if near and abs(wrap(float(goal[2] - self._goal_sent[2]))) <= _SAME_GOAL_RAD:
                return
        if not self._navigator.server_is_ready():
            self.get_logger().warning('no navigator yet', throttle_duration_sec=_WARN_PERIOD_S)
            return
        self._goal_sent = goal
        self._answered_at = self._now()
        request = NavigateToPose.Goal(use_heading=True)
        request.pose = messages.pose_stamped_msg(
            goal, self._map_frame, self.get_clock().now().nanoseconds
        )
        sent = self._navigator.send_goal_async(request, self._on_feedback)
        sent.add_done_callback(lambda f: self._on_accepted(f, goal))

    def _ask_again(self, now: float) -> None:
        """Send the goal again where the navigator says nothing of it.

        The navigator may be another one than the one asked.
        """
        if self._goal_sent is None or now - self._answered_at < _DEAF_S:
            return
        self.get_logger().warning(
            'the navigator is silent: asking again', throttle_duration_sec=_WARN_PERIOD_S
        )
        goal = self._goal_sent
        self._goal_sent = None
        self._handle = None
        if self._state == ExplorationStatus.RETURNING:
            self._drive_to(goal)

    def _on_feedback(self, message: NavigateToPose.Impl.FeedbackMessage) -> None:
        self._answered_at = self._now()

    def _on_accepted(self, future: Future, goal: Array) -> None:
        handle = future.result()
        if goal is not self._goal_sent:
            if handle.accepted:
                # Meanwhile another goal was chosen, or the exploration ended.
                handle.cancel_goal_async()
            return
        if not handle.accepted:
            self._goal_sent = None
            return
        self._handle = handle
        handle.get_result_async().add_done_callback(lambda f: self._on_arrived(f, goal))

    def _on_arrived(self, future: Future, goal: Array) -> None:
        if goal is not self._goal_sent:
            return  # an answer to a goal that was replaced
        result: NavigateToPose.Result = future.result().result
        self._goal_sent = self._handle = None
        if self._state == ExplorationStatus.RETURNING:
            self._failed_homes += not result.success
            if result.success or self._failed_homes >= _GIVE_UP_HOME:
                not_home = '' if result.success else f'; not home: {result.reason}'
                self._end(self._ending[0], self._ending[1] + not_home)
            else:
                self._drive_to(goal)
        elif not result.success:
            self._explorer.target_failed(result.reason)

    # What is told.

    def _publish_end_nodes(self, decision: Decision, scan: LaserScan) -> None:
        end_nodes = [_end_node_msg(node) for node in decision.end_nodes]
        header = messages.header(self._map_frame, messages.stamp_ns(scan.header.stamp))
        self._end_nodes.publish(EndNodeArray(header=header, end_nodes=end_nodes))

    def _end_nodes_msg(self) -> EndNodeArray:
        end_nodes = [] if self._decision is None else self._decision.end_nodes
        nodes = [_end_node_msg(node) for node in end_nodes]
        header = messages.header(self._map_frame, self.get_clock().now().nanoseconds)
        return EndNodeArray(header=header, end_nodes=nodes)

    def _status_msg(self) -> ExplorationStatus:
        now_ns = self.get_clock().now().nanoseconds
        status = ExplorationStatus(
            header=messages.header(self._map_frame, now_ns), state=self._state
        )
        status.reason_code, status.reason = self._ending
        status.distance_m = self._odometer.distance_m
        status.time = messages.duration_msg(self._now() - self._begun_at)
        if self._decision is not None:
            target = self._decision.target
            status.coverage_estimate = self._decision.coverage_estimate
            status.known_area_m2 = self._decision.known_area_m2
            status.reason = status.reason or self._decision.reason
            status.end_nodes_left = sum(
                1 for n in self._decision.end_nodes if n.open_border_m > 0.0
            )
            if target is not None:
                status.has_target = True
                status.target = target.node_id
                status.target_position = Point(x=target.x, y=target.y)
        return status


def _end_node_msg(node: EndNode) -> EndNodeMsg:
    far = node.smallest_distance_m if math.isfinite(node.smallest_distance_m) else 0.0
    return EndNodeMsg(
        node_id=node.node_id,
        position=Point(x=node.x, y=node.y),
        position_probability=node.probability,
        distance_index=node.distance_index,
        angle_index=node.angle_index,
        smallest_distance_m=far,
        angle_span_deg=node.angle_span_deg,
        is_target=node.is_target,
    )


def main() -> None:
    """Run the node."""
    node_main.run(ExplorerNode)


if __name__ == '__main__':
    main()
