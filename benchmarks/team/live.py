"""Two or more robots on a live graph: contacts, and bytes that they send each other.

Usage: python -m benchmarks.team.live [WORLD ...] -o FILE.csv [--robots N] [--runs N]
[--unknown-starts]; worlds of the package, or floors by their names.

Bytes are those of serialized messages, each counted once; `map` is what the robots would send with
their whole maps at 1 Hz instead. With starts that are known, map_joiner has the place of each map
from the beginning; else it has to find them.
"""

import argparse
import math
import os
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from std_msgs.msg import UInt32

from benchmarks.node_processes import Processes, placed_at
from benchmarks.rows import add_record
from benchmarks.worlds import WORLDS, floors
from thinmap_msgs.msg import ExplorationStatus, JoinStatus, MapTiles, TeamClaim, TileRequest
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, ThinmapError
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation.ros_domains import use_free_domain
from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.maps import received_map, received_update
from thinmap_ros.sim.coverage import ObservableCells, observable_cells
from thinmap_ros.sim.drives import random_start
from thinmap_ros.sim.other_robots import starts_side_by_side
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World
from thinmap_ros.tools.demo import map_poses

_ROBOT = '2dx'
_RANGE_M = 8.0
_WORLD = 'dungeon/d114'
_SCAN_LISTENERS = 3  # localizer, explorer and navigator of each robot
_KINDS = {'claims': TeamClaim, 'tiles': MapTiles, 'tile_requests': TileRequest}
_PROFILES = {'claims': qos.SENSOR, 'tiles': qos.TILES, 'tile_requests': qos.STREAM}
_MAP_HEAD_BYTES = 92  # of an OccupancyGrid without cells


@dataclass(frozen=True, eq=False)
class Setting:
    """How many robots explore a world, from where and how fast.

    starts: pose (3,) of each robot; poses: pose (3,) in the world of the frame of each map.
    """

    name: str
    path: Path
    world: World
    starts: list[Array]
    poses: list[Array]
    is_known: bool
    speed_m_s: float
    rate: float
    seed: int

    @property
    def names(self) -> list[str]:
        """Namespaces of the robots."""
        return [f'/robot{number}' for number in range(1, len(self.starts) + 1)]


@dataclass
class _Robot:
    """What is known of a robot: true path, contacts, map, and when it has finished."""

    T_world_map: Array
    receiver: MapReceiver = field(default_factory=MapReceiver)
    xy: Array | None = None
    distance_m: float = 0.0
    contacts: int = 0
    finished_s: float | None = None


class Observer:
    """Counts what a team does and sends."""

    def __init__(self, setting: Setting, goal: ObservableCells) -> None:
        self.now_s = 0.0
        self.joined_s: float | None = None
        self.contacts: list[str] = []
        self.bytes = dict.fromkeys([*_KINDS, 'map'], 0)
        self.robots = {
            name: _Robot(pose) for name, pose in zip(setting.names, setting.poses, strict=True)
        }
        self.node = Node('team_observer')
        self._goal = goal
        self._mapped_s = 0.0
        self.node.create_subscription(Clock, '/clock', self._on_clock, qos.SENSOR)
        self.node.create_subscription(JoinStatus, '/join_status', self._on_joined, qos.LATCHED)
        for kind, message_type in _KINDS.items():
            self._count(kind, message_type)
        for name, robot in self.robots.items():
            self._watch(name, robot)

    def _count(self, kind: str, message_type: type) -> None:
        def add(data: bytes) -> None:
            self.bytes[kind] += len(data)

        profile = _PROFILES[kind]
        deep = QoSProfile(
            depth=1000, reliability=profile.reliability, durability=profile.durability
        )
        self.node.create_subscription(message_type, f'/team/{kind}', add, deep, raw=True)

    def _watch(self, name: str, robot: _Robot) -> None:
        def on_truth(message: PoseStamped) -> None:
            xy = messages.pose_from_msg(message.pose)[:2]
            if robot.xy is not None:
                robot.distance_m += math.dist(robot.xy, xy)
            robot.xy = xy

        def on_contacts(message: UInt32) -> None:
            if message.data > robot.contacts:
                self._add_contact(name)
            robot.contacts = message.data

        def on_status(message: ExplorationStatus) -> None:
            is_over = message.state == ExplorationStatus.FINISHED
            if is_over and robot.finished_s is None:
                robot.finished_s = self.now_s

        def on_map(message: OccupancyGrid) -> None:
            received_map(robot.receiver, message)

        def on_update(message: OccupancyGridUpdate) -> None:
            if robot.receiver.patch is not None:
                received_update(robot.receiver, message)

        node = self.node
        node.create_subscription(PoseStamped, f'{name}/ground_truth', on_truth, qos.STREAM)
        node.create_subscription(UInt32, f'{name}/collisions', on_contacts, qos.LATCHED)
        node.create_subscription(
            ExplorationStatus, f'{name}/exploration_status', on_status, qos.LATCHED
        )
        node.create_subscription(OccupancyGrid, f'{name}/map', on_map, qos.LATCHED)
        node.create_subscription(OccupancyGridUpdate, f'{name}/map_updates', on_update, qos.STREAM)

    def _add_contact(self, name: str) -> None:
        """Note when a robot touched something, and how far from it the nearest other robot was."""
        own = self.robots[name].xy
        others = [each.xy for other, each in self.robots.items() if other != name]
        away = [math.dist(own, xy) for xy in others if own is not None and xy is not None]
        self.contacts.append(f'{name} {self.now_s:.1f} s {min(away, default=math.nan):.2f} m')

    def _on_clock(self, message: Clock) -> None:
        self.now_s = messages.stamp_ns(message.clock) / 1e9
        while self._mapped_s < self.now_s:
            self._mapped_s += 1.0
            for robot in self.robots.values():
                patch = robot.receiver.patch
                if patch is not None:
                    self.bytes['map'] += patch.cells.size + _MAP_HEAD_BYTES

    def _on_joined(self, message: JoinStatus) -> None:
        joined = sum(each.is_joined for each in message.maps)
        if joined == len(self.robots) and self.joined_s is None:
            self.joined_s = self.now_s

    @property
    def is_finished(self) -> bool:
        """Whether all robots have finished."""
        return all(robot.finished_s is not None for robot in self.robots.values())

    def coverage(self) -> float:
        """Share of the floor that one of the maps holds as free."""
        known = [
            self._goal.known(robot.receiver.patch, robot.T_world_map)
            for robot in self.robots.values()
            if robot.receiver.patch is not None
        ]
        return self._goal.share(known) if known else 0.0


def run(setting: Setting, limit_s: float) -> dict[str, str | int | float]:
    """Explore a floor; returns the figures. limit_s: simulated time after which it ends."""
    radius_m = PRESETS[_ROBOT].radius_m
    goal = observable_cells(setting.world, setting.starts[0], radius_m, _RANGE_M)
    observer = Observer(setting, goal)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        processes = Processes(Path(folder))
        try:
            _start(processes, setting)
            while not observer.is_finished and observer.now_s < limit_s:
                rclpy.spin_once(observer.node, timeout_sec=0.1)
                for text in processes.ended().values():
                    raise ThinmapError(text)
        finally:
            processes.close()
    figures = _figures(setting, observer, time.monotonic() - began)
    observer.node.destroy_node()
    return figures


def _start(processes: Processes, setting: Setting) -> None:
    """Start the robots, the simulator and map_joiner."""
    sim_time: dict[str, object] = {'use_sim_time': 'true'}
    joiner = {**sim_time, 'known_init_poses': str(setting.is_known).lower()}
    robots = zip(setting.names, setting.starts, setting.poses, strict=True)
    for name, start, T_world_map in robots:
        given = {
            **placed_at(se2.between(T_world_map, start)),
            'controller.max_speed_m_s': setting.speed_m_s,
            'team': 'true',
            'autostart_exploration': 'true',
        }
        renamed = {'__ns': name, '/tf': 'tf', '/tf_static': 'tf_static'}
        robot = name.strip('/')
        processes.start(robot, {**sim_time, **given}, renamed, 'thinmap_ros.nodes.thinmap')
        axes = zip(('x', 'y', 'yaw'), T_world_map.tolist(), strict=True)
        if setting.is_known:
            joiner |= {f'{name}/map_merge/init_pose_{axis}': at for axis, at in axes}
    processes.start('map_joiner', joiner)
    simulator: dict[str, object] = {
        'world': setting.path,
        'robot': _ROBOT,
        'robots': len(setting.starts),
        'starts': ';'.join(','.join(map(str, start.tolist())) for start in setting.starts),
        'seed': setting.seed,
        'real_time_factor': setting.rate,
        'lockstep': 'local_topology',
        'wait_for_subscribers': _SCAN_LISTENERS,
    }
    processes.start('sim', simulator)


def _figures(setting: Setting, observer: Observer, wall_s: float) -> dict[str, str | int | float]:
    robots = observer.robots.values()
    driven_m = sum(robot.distance_m for robot in robots)
    per_m = {f'{kind}_bytes_m': n / max(driven_m, 1.0) for kind, n in observer.bytes.items()}
    return {
        'world': setting.name,
        'robots': len(setting.starts),
        'starts': 'known' if setting.is_known else 'unknown',
        'seed': setting.seed,
        'finished': int(observer.is_finished),
        'time_s': round(observer.now_s, 1),
        'joined_s': '' if observer.joined_s is None else round(observer.joined_s, 1),
        'distance_m': round(driven_m, 2),
        'coverage': round(observer.coverage(), 5),
        'contacts': sum(robot.contacts for robot in robots),
        'contacts_at': '; '.join(observer.contacts),
        **{name: round(value, 1) for name, value in per_m.items()},
        'wall_s': round(wall_s, 1),
    }


def main() -> None:
    """Run the worlds, and write a line for each."""
    parser = argparse.ArgumentParser(prog='benchmarks.team.live', description=__doc__)
    parser.add_argument('worlds', nargs='*', help=f'default: {_WORLD}', default=[_WORLD])
    parser.add_argument('-o', '--output', type=Path, required=True, help='CSV file')
    parser.add_argument('--robots', type=int, default=2, help='number of robots (default 2)')
    parser.add_argument('--unknown-starts', action='store_true', help='map_joiner has to find them')
    parser.add_argument('--speed-m-s', type=float, default=0.5, help='top speed, m/s (default 0.5)')
    parser.add_argument('--rate', type=float, default=10.0, help='simulated s a second, at most')
    parser.add_argument('--seed', type=int, default=0, help='decides noise and starts (default 0)')
    parser.add_argument('--runs', type=int, default=1, help='of each world, with other seeds')
    parser.add_argument('--time-limit-s', type=float, default=3000.0, help='simulated s')
    parser.add_argument('--folder', type=Path, default=WORLDS, help='folder with worlds.json')
    arguments = parser.parse_args()
    if 'ROS_DOMAIN_ID' not in os.environ:
        use_free_domain()
    rclpy.init()
    for name in arguments.worlds:
        world, path = _world(arguments.folder, name)
        for seed in range(arguments.seed, arguments.seed + arguments.runs):
            rng = np.random.default_rng(seed)
            starts = _starts(world, arguments.robots, rng)
            setting = Setting(
                name,
                path,
                world,
                starts,
                map_poses(starts),
                not arguments.unknown_starts,
                arguments.speed_m_s,
                arguments.rate,
                seed,
            )
            record = run(setting, arguments.time_limit_s)
            add_record(arguments.output, record)
            print(record, flush=True)
    rclpy.shutdown()


def _world(folder: Path, name: str) -> tuple[World, Path]:
    """The floor of that name in a folder, or the world of the package."""
    floor = next((each for each in floors(folder) if each.name == name), None)
    if floor is not None:
        return floor.world, floor.path
    path = package_data.world_path(name)
    return World.from_patch(*read_world(path)), path


def _starts(world: World, robots: int, rng: np.random.Generator) -> list[Array]:
    """Poses (3,) of robots side by side at a random place with room for them."""
    radius_m = PRESETS[_ROBOT].radius_m
    while True:
        try:
            return starts_side_by_side(world, random_start(world, rng), robots, radius_m)
        except InputError:
            continue


if __name__ == '__main__':
    main()
