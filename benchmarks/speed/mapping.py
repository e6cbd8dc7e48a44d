"""From scans to the graph: thinning, insertion of scans, and both on a drive."""

import math
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.morphology import skeletonize

from benchmarks.graphs.graph_metrics import agreement, drivable_share, loop_count
from benchmarks.rows import Row, at_least, at_most
from benchmarks.time_and_memory import best_seconds
from benchmarks.worlds import floor
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid, WindowConfig
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.wavefront import WavefrontConfig, plan
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, pose, wrap
from thinmap_ros.core.topology.graph import Node
from thinmap_ros.core.topology.thinning import thin
from thinmap_ros.core.topology.topology import TopologyBuilder, build
from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig
from thinmap_ros.sim.world import World

Mask = NDArray[np.bool_]
_FASTER = {400: (20.0, 40.0), 1000: (50.0, 100.0), 4000: (50.0, 100.0)}


def floor_of(worlds: Path, side: int) -> Mask:
    """Free cells of a real floor, laid side by side until the size is reached."""
    free = floor('kth/50052749', worlds).world.occupied == 0
    rows, cols = free.shape
    return np.ascontiguousarray(np.tile(free, (-(-side // rows), -(-side // cols)))[:side, :side])


def padded_opencv(free: Mask) -> Mask:
    """Zhang-Suen by OpenCV, padded because it leaves the outermost cells alone."""
    padded = np.pad(free, 1).astype(np.uint8) * 255
    return np.asarray(
        cv2.ximgproc.thinning(padded, thinningType=cv2.ximgproc.THINNING_ZHANGSUEN)[1:-1, 1:-1] > 0
    )


def thinning(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows for each size."""
    cv2.setNumThreads(1)
    for side in (400, 1000) if quick else (400, 1000, 4000):
        free = floor_of(worlds, side)
        assert np.array_equal(thin(free), padded_opencv(free)), 'thinning is not that of the paper'
        grey = free.astype(np.uint8)
        fast = best_seconds(
            {
                'thin': partial(thin, free),
                'copy': free.copy,
                'distance': partial(cv2.distanceTransform, grey, cv2.DIST_L2, 5),
            },
            rounds=30 if side <= 1000 else 5,
        )
        slow = best_seconds(
            {
                'skimage': partial(skeletonize, free),
                'opencv': partial(padded_opencv, free),
            },
            rounds=3 if side <= 1000 else 1,
        )
        yield Row(f'{side} x {side} cells', f'{1e3 * fast["thin"]:.2f} ms')
        for name, limit in zip(('skimage', 'opencv'), _FASTER[side], strict=True):
            yield at_least(f'  times faster than {name}', slow[name] / fast['thin'], limit)
        if side == 1000:
            yield at_most('  time / copy of the mask', fast['thin'] / fast['copy'], 60.0)
            yield at_most(
                '  time / distance transform (L2, 5)', fast['thin'] / fast['distance'], 0.5
            )


_TARGET = 20_000.0
_SCANS = 200


def mapping(worlds: Path, quick: bool) -> list[Row]:
    """A row for cells of 10 cm and of 5 cm: a real floor, rotation in place at ten places."""
    there = floor('kth/50052748', worlds)
    laser = LaserScanner(LaserScannerConfig(), 0)
    turns = [
        np.array([*start[:2], start[2] + 0.3 * k])
        for start in there.starts
        for k in range(_SCANS // 10)
    ]
    scans = [(laser.scan(there.world, T, 0), T) for T in turns]
    what = 'map update, 181 beams, 8 m'
    rate = _rate(OccupancyGrid(PAPER_GRID), scans, quick)
    usual_rate = _rate(OccupancyGrid(), scans, quick)
    return [
        at_least(f'{what}, 10 cm', rate, _TARGET, 'scans/s'),
        Row(f'{what}, 5 cm (the default)', f'{usual_rate:.4g} scans/s'),
    ]


def _rate(grid: OccupancyGrid, scans: list[tuple[Scan, Array]], quick: bool) -> float:
    rounds = 10 if quick else 40
    return len(scans) / best_seconds({'update': lambda: _update(grid, scans)}, rounds)['update']


def _update(grid: OccupancyGrid, scans: list[tuple[Scan, Array]]) -> None:
    for scan, T in scans:
        grid.add_scan(scan, T)


_WINDOW_M = WindowConfig().local_map_size_m
_STEP_M = 0.1  # between scans: half a metre a second at 5 Hz
_TURN_RAD = 0.3
_TRIES = 40
_IN_VIEW_M = 3.0


class _Drive:
    """Robot, laser, grid and builder; seconds of each cycle.

    kept: visible nodes, of those asked for, that kept their ids.
    """

    def __init__(self, world: World) -> None:
        self.grid = OccupancyGrid(PAPER_GRID)
        self.builder = TopologyBuilder()
        self.seconds: list[float] = []
        self.kept = 0
        self.asked = 0
        self._world = world
        self._laser = LaserScanner(LaserScannerConfig(), 0)

    def step(self, T: Array) -> None:
        """Process one scan at a pose (3,) in grid and builder."""
        scan = self._laser.scan(self._world, T, 0)
        before = dict(self.builder.map.nodes)
        started = time.perf_counter()
        self.grid.add_scan(scan, T)
        window = self.grid.window(T[0], T[1], _WINDOW_M)
        self.builder.update(window, T)
        self.seconds.append(time.perf_counter() - started)
        self._compare(before, T)

    def _compare(self, before: dict[int, Node], T: Array) -> None:
        """Count visible nodes whose place still has a node, and how many of them kept their id."""
        after = self.builder.map.nodes
        places = np.array([node.position for node in after.values()]).reshape(-1, 2)
        for number, node in before.items():
            if max(abs(node.x - T[0]), abs(node.y - T[1])) > _IN_VIEW_M:
                continue
            still = bool((np.hypot(*(places - node.position).T) <= 0.5).any())
            self.asked += still
            self.kept += still and number in after


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


_QUICK = ('dungeon/d114',)
_WORLDS = ('dungeon/d114', 'dungeon/d2555', 'kth/50052751', 'kth/50052748')
_WARM_UP = 20
_RUN = 6000  # scans in 20 min


def online(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows for each world, as they come."""
    for name in _QUICK if quick else _WORLDS:
        there = floor(name, worlds)
        poses = tour(there.world, there.starts[0], 0.25, 8 if quick else 40, 0)
        drive = _Drive(there.world)
        for T in poses:
            drive.step(T)
        milliseconds = 1e3 * np.array(drive.seconds[_WARM_UP:])[:_RUN]
        tenth = len(milliseconds) // 10
        graph = drive.builder.map
        x, y, _ = there.starts[0].tolist()
        batch = build(drive.grid.known_area(), (x, y), drive.builder.config)
        near, back = agreement(graph, batch, 0.5)
        yield from [
            Row(name, f'{len(poses)} scans', '', None),
            at_most('  update, median', float(np.median(milliseconds)), 2.0, 'ms'),
            at_most('  update, longest', float(milliseconds.max()), 10.0, 'ms'),
            at_most(
                '  update, last tenth / first tenth',
                float(np.median(milliseconds[-tenth:]) / np.median(milliseconds[:tenth])),
                1.2,
            ),
            at_least('  share of nodes within 0.5 m of a node of the batch map', near, 0.95),
            at_least('  share of nodes of the batch map within 0.5 m of a node', back, 0.95),
            _equal('  loops', loop_count(graph), loop_count(batch)),
            _equal('  components', len(graph.components()), len(batch.components())),
            at_least(
                '  share of nodes in the window that keep their ids',
                drive.kept / max(drive.asked, 1),
                0.99,
            ),
            at_least(
                '  share of drivable edges',
                drivable_share(drive.grid.known_area(), graph, 0.25),
                1.0,
            ),
        ]


def _equal(what: str, found: int, wanted: int) -> Row:
    return Row(what, f'{found}', f'{wanted}', found == wanted)
