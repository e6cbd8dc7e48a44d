"""Exploration node: visits end nodes until all are reliable."""

from dataclasses import replace

from std_srvs.srv import Trigger

from thinmap_msgs.action import Explore
from thinmap_ros import kernels
from thinmap_ros.core.exploration.mission import (
    Action,
    DriveTo,
    Finish,
    Mission,
    MissionGoal,
    MissionState,
    mission_state,
    resumed_mission,
)
from thinmap_ros.core.exploration.strategy import FinishCode, Observation, Strategy
from thinmap_ros.core.snapshot import State
from thinmap_ros.files.sessions import EXPLORATION
from thinmap_ros.nodes.parts.drives import NavigationClient
from thinmap_ros.nodes.parts.mission import (
    ACTION,
    Driver,
    ExplorationSettings,
    ExplorerState,
    ForeignDriver,
    MissionPublishers,
    Starts,
    StrategySource,
)
from thinmap_ros.nodes.parts.observation import ObservationSource
from thinmap_ros.nodes.parts.team_member import Progress, declare_team
from thinmap_ros.ros import node_main, parameters
from thinmap_ros.ros.action_server import Outcome, SingleGoalServer
from thinmap_ros.ros.checkpoint import StateStamp
from thinmap_ros.ros.laser_transform import LaserTransform
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.services import offer
from thinmap_ros.ros.session_services import SaveDirectory, offer_saving
from thinmap_ros.ros.stop_topic import StopTopic

_CHECK_PERIOD_S = 1.0


class ExplorerNode(ThinmapNode):
    """Maps, /topology, /pose or /tf, /scan in; goals of navigate_to_pose, /end_nodes, ... out.

    Without thinmap's other nodes, /map and /tf are enough. Areas of /keep_out count as walls. An
    exploration is always a goal of the action explore, also one that starts by itself. It can be
    paused and continued by explore/resume; /stop ends it for good, as ~/cancel does, whatever has
    started it. Service save_exploration saves what was learned beside the map and the graph of a
    session. An explorer that was killed and is started again continues with the exploration, and
    with the goal of its client, who has to ask again for the result.

    With team: true it shares the unknown area with the other robots of /join_status, by
    /team/claims, and their maps, by /team/tiles.
    """

    def __init__(self) -> None:
        super().__init__('explorer', recovers=True)
        self._strategies = StrategySource(self)
        self._settings = parameters.declare_config(self, ExplorationSettings)
        map_frame = parameters.declare_map_frame(self)
        laser = LaserTransform(self)
        self._settings.apply_base_frame(laser)
        self._team = declare_team(self, map_frame, self._strategies.is_default, self._progress)
        self._session = parameters.declare_session(self)
        offer_saving(self, SaveDirectory(self), EXPLORATION, self._save, self._save_at_end)
        parameters.reject_unknown(self)
        kernels.explorer()
        radius_m = self._strategies.config.planner.robot_radius_m
        self._source = ObservationSource(
            self, self._settings, map_frame, laser, radius_m, self._on_observation
        )
        self._driver = self._make_driver(map_frame)
        self._starts = Starts(self)
        self.reset_state()
        self._output = MissionPublishers(self, map_frame, self._on_resume)
        self._goals = SingleGoalServer(
            self, Explore, ACTION, self._start, self._on_preempted, self._starts.read
        )
        StopTopic(self, self._on_stop)
        offer(self.create_service, Trigger, '~/cancel', self._on_cancel)
        self.create_active_timer(_CHECK_PERIOD_S, self._on_timer)
        self.enable_checkpoint(self._state, self._restore)

    def reset_state(self) -> None:
        """Discard map, graph and what was learned, or restore the session of the start."""
        self._source.reset()
        self._team.reset()
        strategy = self._strategies.initial(self._session)
        self._mission = self._make_mission(MissionGoal(), strategy, MissionState.IDLE)
        self._starts.reset(self._settings.autostart_exploration)
        self._stamp = StateStamp()

    def _state(self) -> State:
        return ExplorerState(
            self._stamp.latest_ns or 0,
            self._goals.goal_id,
            self._driver.goal_prefix,
            mission_state(self._mission, self._now_s()),
            self._strategies.state(self._mission.strategy),
        ).arrays()

    def _restore(self, arrays: State) -> None:
        """Continue with the mission of a killed explorer. Raises InputError for another state."""
        state = ExplorerState.from_arrays(arrays)
        strategy = self._strategies.restored(state.strategy)
        watchdog = self._source.watchdog
        self._team.attach(strategy)
        self._mission = resumed_mission(state.mission, strategy, watchdog, self._now_s())
        self._starts.is_due &= self._mission.state == MissionState.IDLE
        self._stamp.restore(state.latest_ns)
        self._driver.adopt(state.drive_prefix)
        if state.goal_id and self._mission.is_running:
            self._goals.restore(state.goal_id)
        if self._starts.stop_reason:
            self._cancel(self._starts.stop_reason)

    def stop(self) -> None:
        """End the exploration."""
        self._cancel('the explorer was stopped or reset')

    def _cancel(self, reason: str) -> bool:
        """End the exploration, if there is one; returns whether there was."""
        is_running = self._mission.is_running
        if is_running:
            self._execute(self._mission.cancel(reason))
        return is_running

    def _make_driver(self, map_frame: str) -> Driver:
        if self._settings.drive:
            return NavigationClient(
                self,
                self._settings,
                map_frame,
                self._on_drive_ended,
                lambda remaining_m: self._mission.path_grew(remaining_m),
            )
        return ForeignDriver(self._on_drive_ended)

    # Goals of the action, stops, and explore/resume.

    def _start(self, goal: MissionGoal) -> None:
        self._starts.is_due = False
        returns = goal.return_to_start or self._settings.return_to_init
        goal = replace(goal, return_to_start=returns)
        strategy = self._strategies.next(self._mission, goal)
        self._mission = self._make_mission(goal, strategy)
        self._publish_progress()
        self.checkpoint_now()

    def _make_mission(
        self,
        goal: MissionGoal,
        strategy: Strategy,
        state: MissionState = MissionState.EXPLORING,
    ) -> Mission:
        self._team.attach(strategy)
        return Mission(goal, strategy, self._source.watchdog, self._now_s(), state)

    def _on_preempted(self) -> Explore.Result:
        if self._mission.is_running:
            is_canceled = self._goals.is_cancel_requested
            self._mission.cancel('cancelled' if is_canceled else 'replaced by a newer goal')
        return Explore.Result(status=self._output.status_now(self._mission))

    def _on_stop(self, stop: StopTopic) -> None:
        self._starts.stop_changed(stop.reason)
        if stop.reason:
            self._cancel(stop.reason)

    def _on_cancel(self, _: Trigger.Request) -> str:
        was_due = self._starts.is_due
        self._starts.is_due = False
        return 'exploration ended' if self._cancel('cancelled') or was_due else 'none to end'

    def _on_resume(self, is_wanted: bool) -> None:
        """Pause the exploration, or continue one that is paused."""
        if not is_wanted:
            self._mission.is_paused = self._mission.is_running
            self._starts.is_paused = self._starts.is_due
            self._driver.cancel()
        elif self._mission.is_paused or self._starts.is_paused:
            self._mission.is_paused = self._starts.is_paused = False
        else:
            self.get_logger().warning(
                'explore/resume: no exploration is paused: expected a goal of the action explore '
                'to start one'
            )
            return
        self._output.clear_target()
        self._publish_progress()

    # Inputs.

    def _on_observation(self, observation: Observation) -> None:
        """Have the mission process a scan that is in the map."""
        self.touch()
        stamp_ns = observation.scan.stamp_ns
        if self._stamp.is_restarted_by(stamp_ns):
            self.reset('the robot was started again, too')
        self._stamp.latest_ns = stamp_ns
        self._team.observed(observation)
        self._starts.send_if_due()
        self._end_if_cancelled()
        if self._mission.is_running:
            self._driver.robot_moved(observation.T_map_base)
        if not self._mission.is_running:
            return
        is_exploring = self._mission.state == MissionState.EXPLORING
        if is_exploring and not self._mission.is_paused:
            completed = self._team.completed(observation)
            is_joined = completed.patch is not observation.patch
            observation = self._source.completed(completed, is_joined)
        with self.diagnostics.time_step('explorer'):
            action = self._mission.step(observation)
        if is_exploring:
            self._output.end_nodes(self._mission, observation.scan.stamp_ns)
        self._execute(action)

    def _on_drive_ended(self, success: bool, reason: str) -> None:
        self._output.clear_target()
        self._execute(self._mission.drive_ended(success, reason))

    def _on_timer(self) -> None:
        self._end_if_cancelled()
        if not self._mission.is_running:
            return
        self.touch()
        self._execute(self._mission.check(self._now_s(), self._driver.is_driving))
        if self._mission.is_running:
            status = self._output.status(self._mission)
            end_nodes = self._output.end_nodes_now(self._mission)
            self._goals.feedback(Explore.Feedback(status=status, end_nodes=end_nodes))
            self._output.lite.publish_frontiers(self._mission)

    def _end_if_cancelled(self) -> None:
        if self._goals.is_cancel_requested:
            self._cancel('cancelled')

    def _save(self, path: str, overwrite: bool) -> str:
        return self._strategies.save(path, self._mission.strategy, overwrite)

    def _save_at_end(self, path: str) -> str:
        strategy = self._mission.strategy
        return self._save(path, True) if self._strategies.has_learned(strategy) else ''

    # Outputs.

    def _execute(self, action: Action) -> None:
        """Carry out what the mission answers."""
        if isinstance(action, DriveTo):
            self._output.target(action.goal)
            self._driver.drive_to(action.goal)
        elif isinstance(action, Finish):
            self._finish(action)
        self._publish_progress()

    def _finish(self, end: Finish) -> None:
        self._driver.cancel()
        self._output.clear_target()
        status = self._output.status(self._mission)
        self.get_logger().info(f'finished: {end.reason}')
        outcome = Outcome.SUCCEEDED if end.is_success else Outcome.ABORTED
        if end.code == FinishCode.CANCELLED:
            outcome = Outcome.CANCELED
        self._goals.finish(outcome, Explore.Result(status=status))
        self.checkpoint_now()

    def _progress(self, last: Observation | None) -> Progress:
        """The report to the other robots of a team after an observation."""
        return Progress(self._mission, self._source.located(last), self._driver.goal)

    def _publish_progress(self) -> None:
        self._output.lite.publish_status(self._mission, self._driver.is_yielding)

    def _now_s(self) -> float:
        return self.elapsed_time.now_s()


main = node_main.program(ExplorerNode)

if __name__ == '__main__':
    main()
