"""A drive through a world with true poses, with the grid and topological map on the way."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid, WindowConfig
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.wavefront import WavefrontConfig, plan
from thinmap_ros.core.se2 import Array, pose, wrap
from thinmap_ros.core.topology.graph import Node, TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import TopologyBuilder, build
from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig
from thinmap_ros.sim.world import World

WINDOW_M = WindowConfig().local_map_size_m
_STEP_M = 0.1  # between scans: half a metre a second at 5 Hz
_TURN_RAD = 0.3
_TRIES = 40
_IN_VIEW_M = 3.0


@dataclass
class Ledger:
    """Statistics of a drive: seconds of each cycle, and how many visible nodes kept their ids."""

    seconds: list[float] = field(default_factory=list)
    kept: int = 0
    asked: int = 0


class Drive:
    """Robot, laser, grid and builder; `run` drives along poses."""

    def __init__(self, world: World, topology: TopologyConfig | None = None, seed: int = 0) -> None:
        self.world = world
        self.grid = OccupancyGrid(PAPER_GRID)
        self.builder = TopologyBuilder(topology)
        self.ledger = Ledger()
        self._laser = LaserScanner(LaserScannerConfig(), seed)

    def step(self, T: Array, stamp_ns: int = 0) -> None:
        """Process one scan at a pose (3,) in grid and builder."""
        scan = self._laser.scan(self.world, T, stamp_ns)
        before = dict(self.builder.map.nodes)
        started = time.perf_counter()
        self.grid.add_scan(scan, T)
        window = self.grid.window(T[0], T[1], WINDOW_M)
        self.builder.update(window, T)
        self.ledger.seconds.append(time.perf_counter() - started)
        self._compare(before, T)

    def run(self, poses: Iterator[Array] | list[Array]) -> None:
        """Drive along poses."""
        for T in poses:
            self.step(T)

    def _compare(self, before: dict[int, Node], T: Array) -> None:
        """Count visible nodes whose place still has a node, and how many of them kept their id."""
        after = self.builder.map.nodes
        places = np.array([node.position for node in after.values()]).reshape(-1, 2)
        for number, node in before.items():
            if max(abs(node.x - T[0]), abs(node.y - T[1])) > _IN_VIEW_M:
                continue
            still = bool((np.hypot(*(places - node.position).T) <= 0.5).any())
            self.ledger.asked += still
            self.ledger.kept += still and number in after


def tour(world: World, start: Array, radius_m: float, goals: int, seed: int) -> list[Array]:
    """Poses (3,) of a drive, repeatedly to the place of the world farthest from the driven path.

    Paths are planned by the wavefront planner on the world: 0.6 m from walls where possible.
    """
    rng = np.random.default_rng(seed)
    cells = np.where(world.occupied != 0, np.int8(100), np.int8(0))
    patch = GridPatch(world.frame, cells)
    config = WavefrontConfig(robot_radius_m=radius_m + 0.05)
    standing = world.frame.centres_of(np.argwhere(world.distance_to_wall_m > radius_m + 0.1))
    poses = [start]
    been = [start[:2]]
    unseen = np.full(len(standing), np.inf)
    for _ in range(goals):
        unseen = np.minimum(unseen, np.min([np.hypot(*(standing - at).T) for at in been], axis=0))
        for _ in range(_TRIES):
            if unseen.max() < 1.0:
                break
            goal = standing[int(np.argmax(unseen + rng.uniform(0.0, 2.0, len(unseen))))]
            path = plan(patch, (poses[-1][0], poses[-1][1]), (goal[0], goal[1]), config)
            if path is not None:
                break
            unseen[np.hypot(*(standing - goal).T) < 1.0] = 0.0
        else:
            break
        if unseen.max() < 1.0 or path is None:
            break
        been = list(path[::10])
        poses += _along(poses[-1], path)
    return poses


def _along(T: Array, path: Array) -> list[Array]:
    """Poses every _STEP_M along a path, after a rotation in place."""
    travelled = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))))
    marks = np.arange(_STEP_M, travelled[-1], _STEP_M)
    points = np.column_stack([np.interp(marks, travelled, path[:, axis]) for axis in (0, 1)])
    poses = []
    last = T
    for point in points:
        heading = math.atan2(point[1] - last[1], point[0] - last[0])
        while abs(wrap(heading - last[2])) > _TURN_RAD:
            last = pose(
                last[0], last[1], last[2] + math.copysign(_TURN_RAD, wrap(heading - last[2]))
            )
            poses.append(last)
        last = pose(point[0], point[1], heading)
        poses.append(last)
    return poses


def final_map(drive: Drive, start: Array | None) -> TopologicalMap:
    """The batch map of the final grid, of all components or of that of a start."""
    seed_xy = None if start is None else (float(start[0]), float(start[1]))
    return build(drive.grid.known_area(), seed_xy, drive.builder.config)
