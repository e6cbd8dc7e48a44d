"""Fuzz tests of the core with random scans, poses, maps and graphs: results must be valid."""

from pathlib import Path
from typing import Any

import numpy as np
from support.slam_room import ROOM, scan_in

from fuzz.cases import Source, chosen, finite, nothing, tried
from fuzz.files import small_graph, sound_graph, sound_patch
from thinmap_ros.core import se2
from thinmap_ros.core.exploration.explorer import Explorer
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.places.global_localizer import GlobalLocalization
from thinmap_ros.core.places.place_database import GlobalLocalizationConfig
from thinmap_ros.core.planning.navigator import Navigator, NavigatorConfig
from thinmap_ros.core.scan import LaserConfig, Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.sensing.consistency import ConsistencyMonitor
from thinmap_ros.core.slam.localizer import default_config, localizer_class
from thinmap_ros.core.stage import Estimate
from thinmap_ros.core.topology.topology import TopologyBuilder

_PERIOD_NS = 200_000_000
_STRANGE_RANGES = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e-30, 1e30, 7.999, 8.0, 400.0)
_STRANGE = (0.0, -0.0, 1e-300, 1e-9, 1.0, -1.0, 50.0, 1e6, -1e9, 1e300, np.nan, np.inf, -np.inf)


class Drive:
    """A robot in a room with kidnapping, and with occasional failures of laser and odometry."""

    def __init__(self, rng: np.random.Generator, folder: Path) -> None:
        self._rng = rng
        self._diary = (folder / 'drive.txt').open('w')
        self.T = se2.pose(float(rng.uniform(0.5, 9.0)), float(rng.uniform(0.5, 9.0)), 0.0)
        self.T_odom = np.zeros(3)
        self._k = 0

    def move(self) -> None:
        """Make a step; rarely with a discontinuity or an invalid pose."""
        rng = self._rng
        step = se2.pose(float(rng.uniform(0.0, 0.2)), 0.0, float(rng.normal(0.0, 0.2)))
        self.T = se2.compose(self.T, step)
        if rng.random() < 0.05:
            self.T = np.append(rng.uniform(0.0, 10.0, 2), rng.uniform(-4.0, 4.0))
        self.T_odom = se2.compose(self.T_odom, step)
        if rng.random() < 0.05:
            self.T_odom = rng.uniform(-1.0, 1.0, 3) * float(chosen(rng, (0.1, 1.0, 50.0, 1e5)))
        self._k += 1

    def scan(self) -> Scan | None:
        """A scan from the robot's pose, often with faults; None if it was rejected."""
        rng = self._rng
        good = scan_in(ROOM, self.T, stamp_ns=self._k * _PERIOD_NS)
        ranges = good.ranges_m.copy()
        if rng.random() < 0.3:
            at = int(rng.integers(ranges.size))
            ranges[at : at + int(rng.integers(1, 200))] = chosen(rng, _STRANGE_RANGES)
        if rng.random() < 0.1:
            ranges = rng.uniform(-1.0, 9.0, int(chosen(rng, (0, 1, 2, 7, 181, 2_000))))
        numbers = [good.angle_min_rad, good.angle_increment_rad, good.range_min_m, good.range_max_m]
        if rng.random() < 0.1:
            numbers[int(rng.integers(4))] = float(chosen(rng, _STRANGE))
        mount = np.append(rng.uniform(-0.5, 0.5, 2), rng.uniform(-4.0, 4.0))
        mount = mount if rng.random() < 0.1 else np.zeros(3)
        stamp = good.stamp_ns + int(chosen(rng, (0, 0, 0, 0, 0, 0, -(10**9), 10**12)))
        self.tell('scan', stamp, ranges.tolist(), numbers, mount.tolist())
        laser = LaserConfig(
            zero_is_no_return=bool(rng.random() < 0.2),
            max_range_m=float(chosen(rng, (30.0, 30.0, 30.0, 2.0))),
        )
        sweep = (float(chosen(rng, (0.0, 0.2 / 360, -1.0, np.nan))), 0.2)
        made: Scan | None = tried(
            lambda: Scan.create(stamp, ranges, *numbers, mount, laser, *sweep)
        )
        return made

    def tell(self, *words: Any) -> None:
        """Store the next input, to be found after a failure."""
        print(*words, file=self._diary, flush=True)

    def pose(self) -> Array:
        """The robot's pose; occasionally a random or out-of-range one."""
        if self._rng.random() > 0.05:
            return self.T
        size = float(chosen(self._rng, (1.0, 1e3, 1e5, 1e7, 1e300, np.inf, np.nan)))
        T = self._rng.uniform(-1.0, 1.0, 3) * size
        self.tell('pose', T.tolist())
        return T


def map_and_graph(shared: None, rng: np.random.Generator, folder: Path) -> None:
    drive = Drive(rng, folder)
    grid = OccupancyGrid(PAPER_GRID)
    builder = TopologyBuilder()
    explorer = Explorer()
    for _ in range(int(rng.integers(1, 15))):
        drive.move()
        scan = drive.scan()
        if scan is None:
            continue
        T = drive.pose()
        if tried(lambda s=scan, p=T: [grid.add_scan(s, p)]) is None or not se2.is_bounded_pose(T):
            continue
        window = grid.window(T[0], T[1], 16.0)
        sound_patch(window)
        if tried(lambda w=window, p=T: [builder.update(w, p)]) is None:
            continue
        sound_graph(builder.map)
        sound_graph(builder.local_map())
        patch = grid.known_area()
        if patch.cells.size < 4_000_000:
            decision = tried(lambda s=scan, p=T, m=patch: explorer.step(builder.map, m, s, p))
            if decision is not None and decision.target is not None:
                finite(decision.target.goal)
    sound_patch(grid.known_area())


def localize(shared: None, rng: np.random.Generator, folder: Path) -> None:
    drive = Drive(rng, folder)
    config = default_config(str(chosen(rng, ('scan_matching', 'ekf_ti', 'ekf_full'))))
    kind = localizer_class(config)
    localizer = kind(config)
    graph = small_graph()
    for _ in range(int(rng.integers(1, 20))):
        drive.move()
        scan = drive.scan()
        if scan is None:
            continue
        drive.tell('odometry', drive.T_odom.tolist())
        estimate = tried(lambda s=scan: localizer.step(s, drive.T_odom))
        if estimate is not None:
            finite(estimate.T_map_base, estimate.covariance)
            assert np.linalg.eigvalsh(estimate.covariance).min() > -1e-6
        if rng.random() < 0.1:
            localizer.set_topology(graph)
    finite(localizer.optimized_trajectory())
    tried(lambda: kind.from_state(localizer.state(), config))


def check_consistency(shared: None, rng: np.random.Generator, folder: Path) -> None:
    """Poses of whatever localizer and odometry, with any mount, and scans that fit or do not."""
    drive = Drive(rng, folder)
    monitor = ConsistencyMonitor()
    error = np.append(rng.uniform(-0.5, 0.5, 2), rng.uniform(-4.0, 4.0))
    for _ in range(int(rng.integers(20, 300))):
        drive.move()
        scan = drive.scan()
        if scan is None:
            continue
        noise = float(chosen(rng, (0.0, 0.0, 1e-9, 0.01, 10.0)))
        T = se2.compose(drive.T, error) + rng.normal(0.0, noise, 3)
        factor = rng.normal(0.0, 1.0, (3, 3)) * float(chosen(rng, (0.0, 1e-6, 1.0, 1e3, 1e8)))
        information = factor @ factor.T if rng.random() < 0.9 else None
        drive.tell('estimate', T.tolist(), factor.tolist(), drive.T_odom.tolist())
        estimate = Estimate(T, np.eye(3), np.zeros(3), scan_information=information)
        found = monitor.checked(scan, drive.T_odom, estimate)
        for text in (found.mount_fault, *monitor.warnings.values()):
            assert 'nan' not in text.replace('angle_max nan', '') and text.isprintable(), text


def known_room(folder: Path) -> tuple[GridPatch, Any]:
    grid = OccupancyGrid(PAPER_GRID)
    builder = TopologyBuilder()
    for k in range(40):
        T = se2.pose(1.5 + 0.18 * k, 1.5, 0.4 * k)
        grid.add_scan(scan_in(ROOM, T, stamp_ns=k * _PERIOD_NS), T)
        builder.update(grid.window(T[0], T[1], 16.0), T)
    return grid.known_area(), builder.map


def localize_globally(
    shared: tuple[GridPatch, Any], rng: np.random.Generator, folder: Path
) -> None:
    drive = Drive(rng, folder)
    config = GlobalLocalizationConfig(samples=300)
    search = tried(lambda: GlobalLocalization(*shared, config, int(rng.integers(1000))))
    if search is None:
        return
    for _ in range(int(rng.integers(1, 12))):
        drive.move()
        scan = drive.scan()
        if scan is None:
            continue
        drive.tell('odometry', drive.T_odom.tolist())
        result = tried(lambda s=scan: search.step(s, drive.T_odom))
        if result is None:
            continue
        assert result.reason.isprintable() and len(result.reason) < 1000
        finite(search.samples)
        for hypothesis in result.hypotheses:
            finite(hypothesis.T_map_base, hypothesis.covariance, hypothesis.weight)


def _random_map(rng: np.random.Generator) -> GridPatch:
    rows, cols = rng.integers(1, 120, 2)
    cells = np.full((rows, cols), chosen(rng, (0, 0, 0, -1, 100)), dtype=np.int8)
    for _ in range(int(rng.integers(0, 30))):
        row = int(rng.integers(rows))
        col = int(rng.integers(cols))
        tall, wide = (int(rng.integers(1, 40)) for _ in range(2))
        cells[row : row + tall, col : col + wide] = chosen(rng, (0, 0, 100, -1, 50))
    origin = rng.uniform(-6.0, 1.0, 2)
    return GridPatch(GridFrame(float(origin[0]), float(origin[1]), 0.1), cells)


def navigate(shared: None, rng: np.random.Generator, folder: Path) -> None:
    drive = Drive(rng, folder)
    config = NavigatorConfig()
    navigator = Navigator(config)
    for k in range(int(rng.integers(1, 30))):
        if k % 7 == 0:
            patch = _random_map(rng)
            goal = rng.uniform(-2.0, 12.0, 2) * float(chosen(rng, (1.0, 1.0, 1.0, 1e4, 1e9)))
            drive.tell('goal', goal.tolist(), patch.cells.tolist())
            navigator.set_goal(float(goal[0]), float(goal[1]), chosen(rng, (None, 1.0, -3.0)))
        drive.move()
        scan = drive.scan() if rng.random() < 0.8 else None
        T = drive.T
        dt_s = float(chosen(rng, (0.01, 0.1, 0.1, 1.0)))
        command = tried(lambda p=T, m=patch, s=scan, d=dt_s: navigator.step(p, m, s, d))
        if command is None:
            continue
        finite(command.v, command.w)
        assert abs(command.v) <= config.controller.max_speed_m_s + 1e-9
        assert command.state in ('idle', 'driving', 'blocked', 'reached', 'failed')
        finite(navigator.distance_remaining_m)
        if navigator.path is not None:
            finite(navigator.path)


SOURCES = (
    Source('mapping', nothing, map_and_graph),
    Source('localizer', nothing, localize),
    Source('global', known_room, localize_globally),
    Source('navigator', nothing, navigate),
    Source('consistency', nothing, check_consistency),
)
