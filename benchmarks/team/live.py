"""Two or more robots on a live graph: contacts, ghosts, and bytes that they send each other.

Usage: python -m benchmarks.team.live [WORLD ...] -o FILE.csv [--robots N] [--runs N]
[--unknown-starts] [--late] [--restart-joiner]; worlds of the package, or floors by their names.

Ghosts are cells of the joint map that are occupied where a robot was and the world has no wall.
Bytes are those of serialized messages, each counted once; `map` is what the robots would send with
their whole maps at 1 Hz instead. With starts that are known, map_joiner has the place of each map
from the beginning; else it has to find them.
"""

import argparse
import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from scipy.spatial import cKDTree
from std_msgs.msg import UInt32

from benchmarks.node_processes import Processes, placed_at
from benchmarks.rows import add_record
from benchmarks.worlds import WORLDS, floor
from thinmap_msgs.msg import ExplorationStatus, JoinStatus, MapTiles, TeamClaim, TileRequest
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, ThinmapError
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation.ros_domains import use_free_domain
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
_MAPPING = ['localizer', 'grid_mapper', 'topology_builder']
_DRIVING = ['navigator', 'explorer']
_OFF_M = 0.15  # from the next wall: what localization and cells make of it is nearer
_BESIDE_M = 0.4  # a path: the robot itself was there, or what is mapped of its hull
_EVENT_M = 5.0  # driven by all robots together when something happens to the team
_LAST_MAPS = 2  # joint maps after the end: the last one was begun after it
_PATIENCE_S = 60.0  # for them


@dataclass(frozen=True, eq=False)
class Setting:
    """How many robots explore a world, from where and how fast.

    starts: pose (3,) of each robot; poses: pose (3,) in the world of the frame of each map.
    is_last_late: the last robot maps, and tells nothing, until the others have driven some metres;
    is_joiner_killed: map_joiner is killed then, and started again.
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
    is_last_late: bool = False
    is_joiner_killed: bool = False

    @property
    def names(self) -> list[str]:
        """Namespaces of the robots."""
        return [f'/robot{number}' for number in range(1, len(self.starts) + 1)]


def count_ghosts(joint: GridPatch, T_world_joint: Array, world: World, path: Array) -> list[int]:
    """Number of occupied cells of a map where the world has no wall: near a path (N, 2), and all.

    T_world_joint (3,): pose of the map in the world.
    """
    cells = se2.transform_points(T_world_joint, joint.frame.centres_of(np.argwhere(joint.occupied)))
    walls = world.frame.centres_of(np.argwhere(world.occupied))
    off = cells[cKDTree(walls).query(cells)[0] > _OFF_M]
    away_m, _ = cKDTree(path).query(off)
    return [int(np.count_nonzero(away_m < _BESIDE_M)), len(off)]


@dataclass
class _Robot:
    """What is known of a robot: true path, contacts, map, and when it has finished."""

    T_world_map: Array
    receiver: MapReceiver = field(default_factory=MapReceiver)
    path: list[Array] = field(default_factory=list)  # (2,), world frame
    distance_m: float = 0.0
    contacts: int = 0
    finished_s: float | None = None


class Observer:
    """Counts what a team does and sends."""

    def __init__(self, setting: Setting, goal: ObservableCells) -> None:
        self.now_s = 0.0
        self.joined_s: float | None = None
        self.is_joined = False
        self.joint: GridPatch | None = None
        self.joint_maps = 0
        self.contacts: list[str] = []
        self.bytes = dict.fromkeys([*_KINDS, 'map'], 0)
        self.robots = {
            name: _Robot(pose) for name, pose in zip(setting.names, setting.poses, strict=True)
        }
        self.node = Node('team_observer')
        self._goal = goal
        self.T_world_joint = np.zeros(3)
        self._mapped_s = 0.0
        self.node.create_subscription(OccupancyGrid, '/merged_map', self._on_joint_map, qos.LATCHED)
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
            if robot.path:
                robot.distance_m += math.dist(robot.path[-1], xy)
            robot.path.append(xy)

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
        own = self.robots[name].path[-1:]
        others = [each.path[-1:] for other, each in self.robots.items() if other != name]
        away = [math.dist(at, xy) for at in own for other in others for xy in other]
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
        places = {
            each.name: messages.pose_from_msg(each.pose) for each in message.maps if each.is_joined
        }
        self.is_joined = len(places) == len(self.robots)
        if self.is_joined and self.joined_s is None:
            self.joined_s = self.now_s
        if places:
            # The map whose frame the joint map has; where maps bend, its place is not quite 0.
            first = min(places, key=lambda name: float(np.abs(places[name]).max()))
            self.T_world_joint = self.robots[first].T_world_map

    def _on_joint_map(self, message: OccupancyGrid) -> None:
        self.joint = received_map(MapReceiver(), message)
        self.joint_maps += 1

    @property
    def is_finished(self) -> bool:
        """Whether all robots have finished."""
        return all(robot.finished_s is not None for robot in self.robots.values())

    @property
    def driven_m(self) -> float:
        """Distance that all robots together have driven."""
        return sum(robot.distance_m for robot in self.robots.values())

    @property
    def path(self) -> Array:
        """Places (N, 2) where robots have been, world frame."""
        return np.vstack([robot.path for robot in self.robots.values()])

    def coverage(self) -> float:
        """Share of the floor that one of the maps holds as free."""
        known = [
            self._goal.known(robot.receiver.patch, robot.T_world_map)
            for robot in self.robots.values()
            if robot.receiver.patch is not None
        ]
        return self._goal.share(known) if known else 0.0


class Robots:
    """The processes of a run: a robot, and what happens to the team once it has driven."""

    def __init__(self, folder: Path, setting: Setting) -> None:
        self.processes = Processes(folder)
        self._setting = setting
        self._is_event_due = True
        sim_time: dict[str, object] = {'use_sim_time': 'true'}
        self._joiner = {**sim_time, 'known_init_poses': str(setting.is_known).lower()}
        self._given: dict[str, dict[str, object]] = {}
        for name, start, T in zip(setting.names, setting.starts, setting.poses, strict=True):
            self._given[name] = {
                **sim_time,
                **placed_at(se2.between(T, start)),
                'controller.max_speed_m_s': setting.speed_m_s,
                'team': 'true',
                'autostart_exploration': 'true',
            }
            if setting.is_known:
                self._joiner |= placed_in_team(name, T)

    def start(self) -> None:
        """Start the robots, map_joiner and the simulator."""
        setting = self._setting
        *others, last = setting.names
        for name in others:
            self._start_robot(name, [])
        self._start_robot(last, _MAPPING if setting.is_last_late else [])
        self.processes.start('map_joiner', self._joiner)
        simulator: dict[str, object] = {
            'world': setting.path,
            'robot': _ROBOT,
            'robots': len(setting.starts),
            'starts': ';'.join(','.join(map(str, start.tolist())) for start in setting.starts),
            'seed': setting.seed,
            'real_time_factor': setting.rate,
            'lockstep': 'local_topology',
            'wait_for_subscribers': 1 if setting.is_last_late else _SCAN_LISTENERS,
        }
        self.processes.start('sim', simulator)

    def work(self, driven_m: float, is_joined: bool) -> None:
        """Let happen what is due now."""
        setting = self._setting
        if not self._is_event_due or driven_m < _EVENT_M:
            return
        if setting.is_last_late:
            self._is_event_due = False
            self._start_robot(setting.names[-1], _DRIVING)
        elif setting.is_joiner_killed and is_joined:
            self._is_event_due = False
            self.processes.kill('map_joiner')
            self.processes.start('map_joiner', self._joiner)

    def _start_robot(self, name: str, nodes: list[str]) -> None:
        """Start some nodes of a robot in a process; without names, all."""
        renamed = {'__ns': name, '/tf': 'tf', '/tf_static': 'tf_static'}
        label = '_'.join([name.strip('/'), *nodes])
        module = 'thinmap_ros.nodes.thinmap'
        self.processes.start(label, self._given[name], renamed, module, nodes)


def run(setting: Setting, limit_s: float, kept: Path | None) -> dict[str, str | int | float]:
    """Explore a floor; returns the figures. limit_s: simulated time after which it ends.

    kept: folder for the logs, and for joint map and paths; None: nothing is kept.
    """
    radius_m = PRESETS[_ROBOT].radius_m
    goal = observable_cells(setting.world, setting.starts[0], radius_m, _RANGE_M)
    observer = Observer(setting, goal)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        robots = Robots(Path(folder), setting)
        try:
            robots.start()
            _wait(observer, robots, lambda: observer.is_finished or observer.now_s > limit_s)
            end_s = observer.now_s
            _wait_for_joint_maps(observer, robots)
        finally:
            robots.processes.close()
            if kept is not None:
                shutil.copytree(folder, kept, dirs_exist_ok=True)
    figures = _figures(setting, observer, end_s, time.monotonic() - began)
    if kept is not None:
        _keep(observer, kept / 'joint.npz')
    observer.node.destroy_node()
    return figures


def _wait(observer: Observer, robots: Robots, is_over: Callable[[], bool]) -> None:
    while not is_over():
        rclpy.spin_once(observer.node, timeout_sec=0.1)
        robots.work(observer.driven_m, observer.is_joined)
        for text in robots.processes.ended().values():
            raise ThinmapError(text)


def _wait_for_joint_maps(observer: Observer, robots: Robots) -> None:
    """Wait for the joint map of all that was seen; there is none where nothing is joined."""
    enough = observer.joint_maps + _LAST_MAPS
    until = time.monotonic() + _PATIENCE_S
    _wait(observer, robots, lambda: observer.joint_maps >= enough or time.monotonic() > until)


def _keep(observer: Observer, file: Path) -> None:
    """Write the joint map, its pose in the world, and the path of each robot."""
    arrays: dict[str, NDArray[Any]] = {'T_world_joint': observer.T_world_joint}
    arrays |= {name.strip('/'): np.array(each.path) for name, each in observer.robots.items()}
    if observer.joint is not None:
        arrays |= {'cells': observer.joint.cells, 'frame': observer.joint.frame.as_array()}
    np.savez(file, allow_pickle=False, **arrays)


def placed_in_team(name: str, T: Array) -> dict[str, object]:
    """Parameters of a map_joiner that knows the pose (3,) of the map of a robot."""
    axes = zip(('x', 'y', 'yaw'), T.tolist(), strict=True)
    return {f'{name}/map_merge/init_pose_{axis}': at for axis, at in axes}


def _figures(
    setting: Setting, observer: Observer, end_s: float, wall_s: float
) -> dict[str, str | int | float]:
    robots = observer.robots.values()
    driven_m = observer.driven_m
    world = setting.world
    path = observer.path
    ghosts: list[int | str] = ['', '']
    if observer.joint is not None:
        ghosts = [*count_ghosts(observer.joint, observer.T_world_joint, world, path)]
    own = [
        count_ghosts(robot.receiver.patch, robot.T_world_map, world, path)[0]
        for robot in robots
        if robot.receiver.patch is not None
    ]
    per_m = {f'{kind}_bytes_m': n / max(driven_m, 1.0) for kind, n in observer.bytes.items()}
    return {
        'world': setting.name,
        'robots': len(setting.starts),
        'starts': 'known' if setting.is_known else 'unknown',
        'seed': setting.seed,
        'finished': int(observer.is_finished),
        'event': 'late' * setting.is_last_late + 'joiner killed' * setting.is_joiner_killed,
        'time_s': round(end_s, 1),
        'joined_s': '' if observer.joined_s is None else round(observer.joined_s, 1),
        'distance_m': round(driven_m, 2),
        'coverage': round(observer.coverage(), 5),
        'joined': int(observer.is_joined),
        'ghosts': ghosts[0],
        'occupied_off_walls': ghosts[1],
        'own_ghosts': sum(own),
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
    trouble = parser.add_mutually_exclusive_group()
    trouble.add_argument('--late', action='store_true', help='the last robot starts later')
    trouble.add_argument(
        '--restart-joiner', action='store_true', help='map_joiner is killed once all are joined'
    )
    parser.add_argument('--speed-m-s', type=float, default=0.5, help='top speed, m/s (default 0.5)')
    parser.add_argument('--rate', type=float, default=10.0, help='simulated s a second, at most')
    parser.add_argument('--seed', type=int, default=0, help='decides noise and starts (default 0)')
    parser.add_argument('--runs', type=int, default=1, help='of each world, with other seeds')
    parser.add_argument('--time-limit-s', type=float, default=3000.0, help='simulated s')
    parser.add_argument('--keep', type=Path, help='folder for logs, joint map and paths')
    parser.add_argument('--folder', type=Path, default=WORLDS, help='folder with worlds.json')
    arguments = parser.parse_args()
    if 'ROS_DOMAIN_ID' not in os.environ:
        use_free_domain()
    rclpy.init()
    for name in arguments.worlds:
        there = floor(name, arguments.folder)
        for seed in range(arguments.seed, arguments.seed + arguments.runs):
            rng = np.random.default_rng(seed)
            starts = _starts(there.world, arguments.robots, rng)
            setting = Setting(
                name,
                there.path,
                there.world,
                starts,
                map_poses(starts),
                not arguments.unknown_starts,
                arguments.speed_m_s,
                arguments.rate,
                seed,
                arguments.late,
                arguments.restart_joiner,
            )
            kept = arguments.keep and arguments.keep / f'{name.replace("/", "_")}_{seed}'
            record = run(setting, arguments.time_limit_s, kept)
            add_record(arguments.output, record)
            print(record, flush=True)
    rclpy.shutdown()


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
