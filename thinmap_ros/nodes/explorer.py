"""Exploration node: visits end nodes until all are reliable."""

from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import LaserScan

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import (
    EndNodeArray,
    ExplorationStatus,
    ProbabilityGrid,
    SlamStatus,
    TopologicalMap,
)
from thinmap_msgs.srv import SaveMap
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.mission import (
    Action,
    DriveTo,
    Finish,
    InputWatchdog,
    Mission,
    MissionGoal,
    MissionState,
)
from thinmap_ros.core.exploration.observations import Observation, ObservationBuffer
from thinmap_ros.core.exploration.strategy import FinishCode
from thinmap_ros.kernels import warm_up
from thinmap_ros.nodes.exploration.mission_messages import (
    end_nodes_msg,
    mission_goal_from,
    status_msg,
)
from thinmap_ros.nodes.exploration.navigation_client import NavigationClient
from thinmap_ros.nodes.exploration.strategy_source import StrategySource
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.action_server import Outcome, SingleGoalServer
from thinmap_ros.ros.laser_transform import LaserTransform
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.save_directory import SaveDirectory
from thinmap_ros.ros.services import fill_response
from thinmap_ros.ros.subscription import subscribe_guarded

_CHECK_PERIOD_S = 1.0


class ExplorerNode(ThinmapNode):
    """Maps, /topology, /pose, /scan in; navigator's goals, /end_nodes, /exploration_status out.

    Service save_exploration saves what was learned beside the map and the graph of a session.
    """

    def __init__(self) -> None:
        super().__init__('explorer')
        self._strategies = StrategySource(self)
        self._map_frame = parameters.declare_map_frame(self)
        self._laser_transform = LaserTransform(self)
        self._session = parameters.declare_session(self)
        self._save_directory = SaveDirectory(self)
        parameters.reject_unknown(self)
        warm_up.explorer()
        self.reset_state()
        self._make_topics()

    def reset_state(self) -> None:
        """Discard map, graph and what was learned, or restore the session of the start."""
        self._buffer = ObservationBuffer(messages.topology_from_msg(TopologicalMap()))
        self._watchdog = InputWatchdog()
        strategy = self._strategies.initial(self._session)
        self._mission = Mission(
            MissionGoal(), strategy, self._watchdog, self._now_s(), MissionState.IDLE
        )

    def stop(self) -> None:
        """End the exploration."""
        if self._goals.active:
            self._execute(self._mission.cancel('the explorer was stopped or reset'))

    def _make_topics(self) -> None:
        self._end_nodes = self.create_publisher(EndNodeArray, 'end_nodes', qos.LATCHED)
        self._status = self.create_publisher(ExplorationStatus, 'exploration_status', qos.LATCHED)
        subscribe_guarded(self, TopologicalMap, 'topology', self._on_topology, qos.LATCHED)
        subscribe_guarded(self, ProbabilityGrid, 'grid', self._on_grid, qos.LATCHED)
        subscribe_guarded(self, ProbabilityGrid, 'local_grid', self._on_local_grid, qos.LATCHED)
        subscribe_guarded(self, PoseWithCovarianceStamped, 'pose', self._on_pose, qos.STREAM)
        subscribe_guarded(self, LaserScan, 'scan', self._on_scan, qos.SENSOR)
        subscribe_guarded(self, SlamStatus, 'slam_status', self._on_slam_status, qos.STREAM)
        self._navigation = NavigationClient(self, self._map_frame, self._on_drive_ended)
        self._goals = SingleGoalServer(
            self, Explore, 'explore', self._on_goal, self._on_cancel, self._on_preempted
        )
        self.create_service(SaveMap, 'save_exploration', self._on_save)
        self.create_active_timer(_CHECK_PERIOD_S, self._on_timer)

    # Goals of the action.

    def _on_goal(self, message: Explore.Goal) -> None:
        try:
            self._start(mission_goal_from(message))
        except InputError as error:
            self._start(MissionGoal())
            self._execute(self._mission.cancel(str(error)))

    def _start(self, goal: MissionGoal) -> None:
        strategy = self._strategies.next(self._mission, goal)
        self._mission = Mission(goal, strategy, self._watchdog, self._now_s())

    def _on_cancel(self) -> None:
        self._mission.request_cancel()

    def _on_preempted(self) -> Explore.Result:
        if self._goals.active:
            self._mission.cancel('replaced by a newer goal')
        return Explore.Result(status=self._status_msg())

    # Inputs.

    def _on_topology(self, message: TopologicalMap) -> None:
        self._buffer.topology = messages.topology_from_msg(message)

    def _on_grid(self, message: ProbabilityGrid) -> None:
        self._buffer.replace_map(messages.grid_from_msg(message))

    def _on_local_grid(self, message: ProbabilityGrid) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        self._process(self._buffer.add_local_map(stamp_ns, messages.grid_from_msg(message)))

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        self._process(self._buffer.add_pose(stamp_ns, messages.pose_from_msg(message.pose.pose)))

    def _on_scan(self, message: LaserScan) -> None:
        scan = self._laser_transform.to_scan(message)
        if scan.is_blind:
            return  # ignored: a blind scan observes nothing
        self._watchdog.add_scan(self._now_s())
        self._process(self._buffer.add_scan(scan))

    def _on_slam_status(self, message: SlamStatus) -> None:
        self._watchdog.add_tracking(message.state == SlamStatus.LOST, self._now_s())

    def _on_drive_ended(self, success: bool, reason: str) -> None:
        self._execute(self._mission.drive_ended(success, reason))

    def _on_timer(self) -> None:
        if not self._goals.active:
            return
        self._execute(self._mission.check(self._now_s(), self._navigation.is_driving))
        if self._goals.active:
            status = self._status_msg()
            self._status.publish(status)
            now_ns = self.get_clock().now().nanoseconds
            end_nodes = end_nodes_msg(self._mission, self._map_frame, now_ns)
            self._goals.feedback(Explore.Feedback(status=status, end_nodes=end_nodes))

    def _on_save(self, request: SaveMap.Request, response: SaveMap.Response) -> SaveMap.Response:
        def save() -> str:
            path = self._save_directory.resolve(request.path)
            return self._strategies.save(path, self._mission.strategy)

        return fill_response(response, save)

    # Outputs.

    def _process(self, observation: Observation | None) -> None:
        """Have the mission process a scan that is in the map."""
        if observation is None or not self._goals.active:
            return
        was_exploring = self._mission.state == MissionState.EXPLORING
        with self.diagnostics.time_step('explorer'):
            action = self._mission.step(observation)
        if was_exploring:
            stamp_ns = observation.scan.stamp_ns
            self._end_nodes.publish(end_nodes_msg(self._mission, self._map_frame, stamp_ns))
        self._execute(action)

    def _execute(self, action: Action) -> None:
        """Carry out what the mission answers."""
        if isinstance(action, DriveTo):
            self._navigation.drive_to(action.goal)
        elif isinstance(action, Finish):
            self._finish(action)

    def _finish(self, end: Finish) -> None:
        self._navigation.cancel()
        status = self._status_msg()
        self._status.publish(status)
        self.get_logger().info(f'finished: {end.reason}')
        outcome = Outcome.SUCCEEDED if end.is_success else Outcome.ABORTED
        if end.code == FinishCode.CANCELLED:
            outcome = Outcome.CANCELED
        self._goals.finish(outcome, Explore.Result(status=status))

    def _status_msg(self) -> ExplorationStatus:
        return status_msg(self._mission, self._map_frame, self.get_clock().now().nanoseconds)

    def _now_s(self) -> float:
        return float(self.get_clock().now().nanoseconds) / 1e9


def main() -> None:
    """Run the node."""
    node_main.run(ExplorerNode)


if __name__ == '__main__':
    main()
