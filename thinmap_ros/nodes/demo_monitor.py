"""Requests explorations, shows their progress in a bar, and writes their results to a file."""

import json
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from thinmap_msgs.msg import JoinStatus
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.files import package_data
from thinmap_ros.files.safe import write_text
from thinmap_ros.files.worlds import read_world
from thinmap_ros.nodes.parts.simulation import RequestedExploration, poses_from
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.time_jumps import STEADY
from thinmap_ros.sim.coverage import robot_observable_cells
from thinmap_ros.sim.other_robots import MAX_ROBOTS
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World
from thinmap_ros.view.progress_bar import ProgressBar

_PERIOD_S = 0.5
# Of several robots, after the last exploration: map_joiner searches in the background.
_JOIN_PATIENCE_S = 20.0
_LAST_MERGE_S = 3.0


@dataclass(frozen=True)
class DemoMonitorConfig(Config):
    """Parameters of the monitor."""

    world: str = parameter('room_10x10', 'World whose coverage is shown.')
    robot: str = parameter('2dx', 'Preset of the robot.', choices=tuple(PRESETS))
    map_poses: str = parameter(
        '',
        'Pose in the world of the map frame of each of several robots, as "x,y,theta; x,y,theta" '
        '(m, m, rad); their topics are in the namespaces robot1, robot2, ... Empty: one robot, '
        'whose map frame is the world.',
    )
    range_max_m: float = parameter(8.0, 'Range of the laser (m).', low=0.1, high=200.0)
    time_limit_s: float = parameter(
        0.0, 'Simulated time after which the exploration ends (s). 0: none.', low=0.0
    )
    result: str = parameter('', 'JSON file for the result. Empty: none.')


class DemoMonitorNode(Node):
    """Client of the action explore, or of that of each of several robots."""

    def __init__(self) -> None:
        super().__init__('demo_monitor')
        config = parameters.declare_config(self, DemoMonitorConfig)
        parameters.reject_unknown(self)
        self._result = config.result
        self._is_team = bool(config.map_poses)
        world = World.from_patch(*read_world(package_data.world_path(config.world)))
        self._coverable = robot_observable_cells(
            world, world.start, PRESETS[config.robot], config.range_max_m
        )
        self._known: dict[str, NDArray[np.bool_]] = {}
        self.finished = False
        self._bar = ProgressBar('area seen')
        self._bar.show(0.0, 'waiting for the nodes')
        self._robots = {
            prefix: self._robot(prefix, T_world_map, config.time_limit_s)
            for prefix, T_world_map in _map_poses(config).items()
        }
        self._ended_s: float | None = None
        self._is_joined = False
        if self._is_team:
            self.create_subscription(JoinStatus, 'join_status', self._on_joined, qos.LATCHED)
        self.create_timer(_PERIOD_S, self._work, clock=STEADY)

    def close(self) -> None:
        """End the bar, so that the next output starts on a new line."""
        self._bar.close()

    def _robot(self, prefix: str, T_world_map: Array, time_limit_s: float) -> RequestedExploration:
        def on_map(patch: GridPatch) -> None:
            self._known[prefix] = self._coverable.known(patch, T_world_map)

        return RequestedExploration(self, prefix, time_limit_s, on_map, self._show)

    def _on_joined(self, message: JoinStatus) -> None:
        joined = [robot for robot in message.maps if robot.is_joined]
        if len(joined) == len(self._robots) and not self._is_joined:
            self._is_joined = True
            if self._ended_s is not None:  # the map of this join is still to come
                self._ended_s = monotonic()

    def _work(self) -> None:
        for robot in self._robots.values():
            robot.work()
        if self._ended_s is not None:
            patience_s = _LAST_MERGE_S if self._is_joined else _JOIN_PATIENCE_S
            self.finished = monotonic() - self._ended_s > patience_s

    def _show(self) -> None:
        robots = list(self._robots.values())
        known = list(self._known.values())
        coverage = self._coverable.share(known) if known else 0.0
        statuses = [robot.status for robot in robots if robot.status is not None]
        distance_m = sum(status.distance_m for status in statuses)
        elapsed_s = max(messages.seconds(status.elapsed) for status in statuses)
        doing = robots[0].doing
        if self._is_team:
            exploring = sum(robot.result is None for robot in robots)
            joined = 'joined' if self._is_joined else 'not yet joined'
            doing = f'{exploring} of {len(robots)} robots explore, maps are {joined}'
        self._bar.show(coverage, f'{distance_m:.1f} m, {elapsed_s:.0f} s: {doing}')
        if self._ended_s is None and all(robot.result is not None for robot in robots):
            self._end()

    def _end(self) -> None:
        if self._result:
            results = {prefix: robot.result for prefix, robot in self._robots.items()}
            content: dict[str, Any] = {
                'robots': [
                    {'name': prefix.rstrip('/'), **(result or {})}
                    for prefix, result in results.items()
                ]
            }
            if not self._is_team:
                content = results[''] or {}
            write_text(Path(self._result), json.dumps(content) + '\n')
        self._ended_s = monotonic()
        self.finished = not self._is_team


def _map_poses(config: DemoMonitorConfig) -> dict[str, Array]:
    """Pose (3,) in the world of the map frame of each robot, by the prefix of its names."""
    if not config.map_poses:
        return {'': np.zeros(3)}
    poses = poses_from('map_poses', config.map_poses)
    if len(poses) > MAX_ROBOTS:
        raise ConfigError(f'map_poses: {len(poses)} poses: expected at most {MAX_ROBOTS}')
    return {f'robot{number}/': pose for number, pose in enumerate(poses, 1)}


main = node_main.program(DemoMonitorNode)

if __name__ == '__main__':
    main()
