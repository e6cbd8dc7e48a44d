"""Requests an exploration, shows its progress in a bar, and writes its result to a file."""

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

from action_msgs.msg import GoalStatus
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import ExplorationStatus
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.map_receiver import MapReceiver
from thinmap_ros.files import package_data
from thinmap_ros.files.atomic import write_text
from thinmap_ros.files.worlds import read_world
from thinmap_ros.nodes.exploration.goal_result import GoalResult
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.decoding.map_updates import received_map, received_update, updates_topic
from thinmap_ros.sim.coverage import observable_cells
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World
from thinmap_ros.view.progress_bar import ProgressBar

_PERIOD_S = 0.5
# Without an answer for this time, the goal is sent again: an explorer that has just been discovered
# may be unable to answer.
_RESEND_S = 10.0


@dataclass(frozen=True)
class DemoMonitorConfig(Config):
    """Parameters of the monitor."""

    world: str = parameter('room_10x10', 'World whose coverage is shown.')
    robot: str = parameter('2dx', 'Preset of the robot.', choices=tuple(PRESETS))
    range_max_m: float = parameter(8.0, 'Range of the laser (m).', low=0.1, high=200.0)
    time_limit_s: float = parameter(
        0.0, 'Simulated time after which the exploration ends (s). 0: none.', low=0.0
    )
    result: str = parameter('', 'JSON file for the result. Empty: none.')


class DemoMonitorNode(Node):
    """Client of the action explore."""

    def __init__(self) -> None:
        super().__init__('demo_monitor')
        self._config = parameters.declare_config(self, DemoMonitorConfig)
        parameters.reject_unknown(self)
        world = World.from_patch(*read_world(package_data.world_path(self._config.world)))
        radius = PRESETS[self._config.robot].radius_m
        self._coverable = observable_cells(world, world.start, radius, self._config.range_max_m)
        self._coverage = 0.0
        self._sent: Any = None
        self._sent_at = 0.0
        self._accepted = False
        self.finished = False
        self._bar = ProgressBar('area seen')
        self._bar.show(0.0, 'waiting for the nodes')
        self._explore = ActionClient(self, Explore, 'explore')
        self._map = MapReceiver()
        self.create_subscription(OccupancyGrid, 'map', self._on_map, qos.LATCHED)
        updates = updates_topic(self, 'map')
        self.create_subscription(OccupancyGridUpdate, updates, self._on_update, qos.STREAM)
        self.create_timer(_PERIOD_S, self._send_goal, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def close(self) -> None:
        """End the bar, so that the next output starts on a new line."""
        self._bar.close()

    def _send_goal(self) -> None:
        if self._accepted or not self._explore.server_is_ready():
            return
        if self._sent is not None and monotonic() - self._sent_at < _RESEND_S:
            return
        goal = Explore.Goal(time_limit_s=self._config.time_limit_s)
        self._sent_at = monotonic()
        self._sent = self._explore.send_goal_async(goal, self._on_feedback)
        self._sent.add_done_callback(self._on_accepted)

    def _on_accepted(self, future: Future) -> None:
        if future is not self._sent:
            return  # replaced by a newer goal
        self._accepted = True
        GoalResult(self, 'explore', future.result(), self._on_result)

    def _on_map(self, message: OccupancyGrid) -> None:
        self._coverage = self._coverable.coverage(received_map(self._map, message))

    def _on_update(self, message: OccupancyGridUpdate) -> None:
        with suppress(InputError):  # of a map that has not come yet
            patch = received_update(self._map, message)
            if patch is not None:
                self._coverage = self._coverable.coverage(patch)

    def _on_feedback(self, message: Explore.Impl.FeedbackMessage) -> None:
        self._show(message.feedback.status)

    def _show(self, status: ExplorationStatus) -> None:
        position = status.target_position
        target = (
            f'to the end node at {position.x:.1f}, {position.y:.1f}'
            if status.has_target
            else 'looking around'
        )
        doing = target if status.state == ExplorationStatus.EXPLORING else status.reason
        self._bar.show(
            self._coverage,
            f'{status.distance_m:.1f} m, {messages.seconds(status.elapsed):.0f} s: {doing}',
        )

    def _on_result(self, ended: Any) -> None:
        status: ExplorationStatus = ended.result.status
        if ended.status == GoalStatus.STATUS_UNKNOWN:
            status.reason = 'the explorer was started again, and does not know the exploration'
        self._show(status)
        if self._config.result:
            end_ns = messages.stamp_ns(status.header.stamp)
            content = {
                'finished': ended.status == GoalStatus.STATUS_SUCCEEDED
                and status.reason_code != ExplorationStatus.BUDGET_EXHAUSTED,
                'reason': status.reason,
                'start_ns': end_ns - round(1e9 * messages.seconds(status.elapsed)),
                'end_ns': end_ns,
            }
            write_text(Path(self._config.result), json.dumps(content) + '\n')
        self.finished = True


def main() -> None:
    """Run the node."""
    node_main.run(DemoMonitorNode)


if __name__ == '__main__':
    main()
