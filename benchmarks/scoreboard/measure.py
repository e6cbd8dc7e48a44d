"""One case of the scoreboard: the numbers that stand for it."""

import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.scoreboard.board import LARGEST
from benchmarks.scoreboard.cases import (
    EXACT_S,
    BuildingCase,
    Case,
    DriveCase,
    LogCase,
    LoopCase,
    flat,
)
from benchmarks.scoreboard.drives import samples
from benchmarks.scoreboard.played import (
    Numbers,
    Played,
    PlayedPipeline,
    rehearse,
    simulated_numbers,
)
from benchmarks.scoreboard.recordings import RecordedSimulation, read_recording
from benchmarks.time_and_memory import forget_peak, peak_mb
from benchmarks.worlds import floor
from thinmap_ros.closed_loop.loop import ClosedLoop, make_loop, no_progress
from thinmap_ros.closed_loop.robot import Options, SimulatedRobot
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizer import config_with
from thinmap_ros.core.stage import StartConfig
from thinmap_ros.evaluation.exploration_run import observable_cells
from thinmap_ros.evaluation.trajectory_errors import read_columns, relation_errors
from thinmap_ros.experiments.slam.logs import laser_of
from thinmap_ros.logs.reading import open_log, paired_scans
from thinmap_ros.pipeline import PipelineConfig
from thinmap_ros.sim.coverage import ObservableCells
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS

LASERS = {
    'lms200': LaserScannerConfig(),
    'turtlebot3': LaserScannerConfig(beams=360, field_of_view_deg=360.0, range_max_m=3.5),
    'rplidar_a1': LaserScannerConfig(beams=360, field_of_view_deg=360.0, range_max_m=12.0),
}
RECORDED_S = 1200.0  # of a recorded drive: 6,000 scans
_ROBOT = PRESETS['2dx']
_SPEED_M_S = 0.5
_RECORDED_SEED = 0
# A robot that has not finished by then goes round in circles; the largest floor takes too long.
_LIMIT_S = 3000.0
_LIMITS_S = {LARGEST: 1200.0}
# What is cut short is not asked for its coverage, which takes long to prepare on a large floor.
_NOTHING = ObservableCells(np.zeros((0, 0), dtype=np.bool_), GridFrame(0.0, 0.0, 0.1))


_KNOWN_AGAIN_M = 30.0  # of way after a slip or a gap, from which on relations over it are judged
_DISTURBED_BY = (5e-4, 5e-4, 5e-4)  # of odometry between scans, m, m, rad, in runs but the first


@dataclass(frozen=True)
class Task:
    """A case, and what it is measured with.

    data: folder of logs and worlds; degrade: the program that degrades a log; folder: for what is
    degraded; options: of the localizer; recordings: folder of recorded drives; scans_per_graph: as
    of the pipeline; made: line of commit and machine.
    """

    case: Case
    data: Path
    degrade: Path
    folder: Path
    options: Numbers
    recordings: Path = Path()
    scans_per_graph: int = 1
    made: str = ''

    @property
    def name(self) -> str:
        """That of the case."""
        return self.case.name


def measure(task: Task) -> Numbers:
    """Name, options and numbers of a case, and what it took of the processor."""
    began = time.process_time()
    case = task.case
    if isinstance(case, LogCase):
        numbers = _measure_log(case, task)
    elif isinstance(case, BuildingCase):
        numbers = _measure_building(case, task)
    elif isinstance(case, DriveCase):
        numbers = _measure_drive(case, task)
    else:
        numbers = _measure_loop(case, task)
    taken = {'cpu_s': time.process_time() - began, 'made': task.made}
    return {'name': task.name, 'options': task.options, **taken, **numbers}


def _measure_log(case: LogCase, task: Task) -> Numbers:
    """Numbers of a log, degraded if the case says so."""
    own = task.data / 'logs' / case.log
    if case.version:
        own = _degraded(case, own, task.degrade, task.folder)
    scans = _disturbed(scans_of(own, case.log), case.run)
    played = play(scans, config_of(task.options), task.scans_per_graph)
    numbers = played.numbers()
    times = np.array(played.stamps_ns) / 1e9
    live = np.array(played.poses)
    if not (own / 'relations').exists():
        return numbers
    for name, path in (('live', live), ('final', played.final)):
        numbers |= _relations(own, times, path, name, case.exact_s)
    return numbers | _over_the_event(own, times, live, case.exact_s)


def _relations(own: Path, times: Array, path: Array, name: str, exact_s: float) -> Numbers:
    """Mean errors of a path (N, 3) by the relations of a log's folder."""
    odometry = own / 'odom.txt'
    errors = relation_errors(times, path, own / 'relations', odometry, exact_s)
    numbers = {
        f'{name}_m': float(errors.metres.mean()),
        f'{name}_deg': float(errors.degrees.mean()),
    }
    if exact_s > EXACT_S:
        carried = relation_errors(times, path, own / 'relations', odometry, EXACT_S)
        numbers[f'exact_{name}_m'] = float(carried.metres.mean())
    again = own / 'relations_again'
    if again.exists() and read_columns(again, [0]).size:
        errors = relation_errors(times, path, again, odometry, exact_s)
        numbers[f'again_{name}_m'] = float(errors.metres.mean())
    return numbers


def _over_the_event(own: Path, times: Array, poses: Array, exact_s: float) -> Numbers:
    """Errors of relations that begin before a slip or a gap and end on known ground after it."""
    for name in ('slip.txt', 'gap.txt'):
        if not (own / name).exists():
            continue
        began, ended = read_columns(own / name, [0, 1])[0]
        wheels = read_columns(own / 'odom.txt', [0, 1, 2])
        after = wheels[wheels[:, 0] > ended]
        way = np.cumsum(np.hypot(*np.diff(after[:, 1:], axis=0).T))
        far = np.flatnonzero(way > _KNOWN_AGAIN_M)
        if not len(far):
            return {}
        again_s = after[far[0] + 1, 0]
        over: list[float] = []
        for file in ('relations', 'relations_again'):
            if not (own / file).exists():
                continue
            ends = read_columns(own / file, [0, 1])
            errors = relation_errors(times, poses, own / file, own / 'odom.txt', exact_s)
            spans = (ends.min(axis=1) < began) & (ends.max(axis=1) > again_s)
            over += errors.metres[spans].tolist()
        return {'over_m': float(np.mean(over)), 'over': len(over)} if over else {}
    return {}


def _degraded(case: LogCase, own: Path, degrade: Path, folder: Path) -> Path:
    """Folder of the degraded log, made where it is not there yet.

    Each run has its own: two that run at once would write into one.
    """
    made = folder / case.name
    if not (made / 'done').exists():
        log = next(own.glob('log.clf*'))
        command = [sys.executable, str(degrade), str(log), str(made), *case.options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise InputError(f'{case.name}: {degrade.name}: {done.stderr.strip()[-200:]}')
        (made / 'done').touch()
    return made


def scans_of(own: Path, laser: str) -> Iterator[tuple[Scan, Array]]:
    """Scans with the odometry at their stamps, in the order of the file."""
    return paired_scans(open_log(next(own.glob('log.clf*')), laser_of(own, laser)))


def _disturbed(pairs: Iterator[tuple[Scan, Array]], run: int) -> Iterator[tuple[Scan, Array]]:
    """Scans with odometry poses (3,) that are disturbed, by the number of the run; 0: they are not.

    By less than any wheels err: what comes out otherwise is the estimate's own instability.
    """
    if run == 0:
        yield from pairs
        return
    rng = np.random.default_rng(run)
    last: Array | None = None
    T_odom_base = np.zeros(3)
    for scan, T in pairs:
        if last is None:
            T_odom_base = T
        else:
            increment = se2.between(last, T) + rng.normal(0.0, _DISTURBED_BY)
            T_odom_base = se2.compose(T_odom_base, increment)
        last = T
        yield scan, T_odom_base


def _measure_building(case: BuildingCase, task: Task) -> Numbers:
    """Numbers of a drive through a generated building."""
    drive = list(samples(case.seed, case.robot, case.noise))
    truth = np.array([sample.T_world_base for sample in drive])
    config = config_of(task.options, truth[0])
    pairs = _disturbed(((sample.scan, sample.T_odom_base) for sample in drive), case.run)
    return simulated_numbers(play(pairs, config, task.scans_per_graph), truth)


def config_of(options: Numbers, start: Array | None = None) -> StartConfig:
    """Configuration of the localizer by its options, with a start pose (3,) where one is given."""
    if start is None:
        return config_with(options)
    x, y, yaw = start.tolist()
    pose = {'initial_x_m': x, 'initial_y_m': y, 'initial_yaw_rad': yaw}
    return config_with(options | pose)


def play(
    scans: Iterator[tuple[Scan, Array]], config: StartConfig, scans_per_graph: int = 1
) -> Played:
    """All scans with their odometry poses (3,) through localizer, grid and topology.

    Raises InputError where there is no scan.
    """
    rehearse()
    pipeline = PlayedPipeline(
        PipelineConfig(localizer=config, grid=PAPER_GRID, scans_per_graph=scans_per_graph)
    )
    forget_peak()
    for scan, T_odom_base in scans:
        pipeline.step(scan, T_odom_base)
    played = pipeline.played
    if not played.poses:
        raise InputError('no scan with odometry around its stamp')
    played.final = pipeline.localizer.optimized_trajectory()
    played.peak_mb = peak_mb()
    return played


@dataclass(frozen=True)
class RecordTask:
    """A drive to record."""

    world: str
    worlds: Path
    recordings: Path

    @property
    def name(self) -> str:
        """That of the recording."""
        return flat(self.world)


def record(task: RecordTask) -> Numbers:
    """Record a drive; returns what it took and how it ended."""
    began = time.process_time()
    numbers = record_drive(task.world, task.worlds, task.recordings / f'{task.name}.npz')
    return {'name': task.name, 'cpu_s': time.process_time() - began, **numbers}


def record_drive(world: str, worlds: Path, path: Path, limit_s: float = RECORDED_S) -> Numbers:
    """Record an exploration by the true pose, from a world's first start, into a file."""
    there = floor(world, worlds)
    start = there.starts[0]
    simulation = RecordedSimulation(there.world, start, _ROBOT, LASERS['lms200'], _RECORDED_SEED)
    loop = ClosedLoop([SimulatedRobot(simulation, Options(speed_m_s=_SPEED_M_S))])
    ending = loop.run(_NOTHING, limit_s, no_progress)
    recording = simulation.recording()
    recording.write(path)
    return {
        'scans': len(recording.stamps_ns),
        'distance_m': se2.path_length_m(recording.T_world_base),
        'reason': ending.reason,
        'collisions': ending.collisions,
    }


def _measure_drive(case: DriveCase, task: Task) -> Numbers:
    """Numbers of a recorded drive with the odometry noise of the case's seed."""
    recording = read_recording(task.recordings / f'{flat(case.world)}.npz')
    truth = recording.T_world_base
    config = config_of(task.options, truth[0])
    samples = recording.replay(_ROBOT, case.odometry_seed)
    pairs = ((sample.scan, sample.T_odom_base) for sample in samples)
    return simulated_numbers(play(pairs, config, task.scans_per_graph), truth)


def _measure_loop(case: LoopCase, task: Task) -> Numbers:
    """Numbers of an exploration by the estimated pose."""
    there = floor(case.world, task.data / 'worlds')
    world = there.world
    start = there.starts[0]
    options = Options(seed=case.seed, speed_m_s=_SPEED_M_S, laser=LASERS[case.laser])
    loop = make_loop(world, [start], options)
    (robot,) = loop.robots
    is_whole = case.world not in _LIMITS_S
    goal = observable_cells(world, start, options) if is_whole else _NOTHING
    rehearse()
    localizer = config_of(task.options, start)
    pipeline = PlayedPipeline(replace(robot.pipeline.config, localizer=localizer))
    robot.pipeline = pipeline
    forget_peak()
    ending = loop.run(goal, _LIMITS_S.get(case.world, _LIMIT_S), no_progress)
    played = pipeline.played
    played.final = pipeline.localizer.optimized_trajectory()
    played.peak_mb = peak_mb()
    truth = np.array(robot.log.true_poses)
    coverage = {'coverage': loop.coverage[-1][1]} if is_whole else {}
    return {
        **simulated_numbers(played, truth),
        **coverage,
        'collisions': ending.collisions,
        'finished': ending.finished,
        'reason': ending.reason,
        'distance_m': se2.path_length_m(truth),
        'time_s': played.stamps_ns[-1] / 1e9,
    }
