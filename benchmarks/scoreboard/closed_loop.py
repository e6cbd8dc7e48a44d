"""Explorations of the scoreboard: by the true pose, recorded, and by the estimated one."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.scoreboard.board import LARGEST
from benchmarks.scoreboard.cases import DriveCase, LoopCase, flat
from benchmarks.scoreboard.measure import config_of, play
from benchmarks.scoreboard.played import Numbers, PlayedPipeline, rehearse, simulated_numbers
from benchmarks.scoreboard.recordings import RecordedSimulation, Recording, read_recording
from benchmarks.time_and_memory import forget_peak, peak_mb
from benchmarks.worlds import floors
from thinmap_ros.closed_loop import (
    SCANS_PER_GRAPH,
    ClosedLoop,
    explorer_config,
    ground_truth_poses,
    no_progress,
)
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.planning.navigator import Navigator, NavigatorConfig
from thinmap_ros.core.planning.path_follower import PathFollowerConfig
from thinmap_ros.core.se2 import Array
from thinmap_ros.files.worlds import read_world
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.sim.coverage import ObservableCells, robot_observable_cells
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.simulation import Simulation
from thinmap_ros.sim.world import World
from thinmap_ros.strategies import DEFAULT, make_strategy

LASERS = {
    'lms200': LaserScannerConfig(),
    'turtlebot3': LaserScannerConfig(beams=360, field_of_view_deg=360.0, range_max_m=3.5),
    'rplidar_a1': LaserScannerConfig(beams=360, field_of_view_deg=360.0, range_max_m=12.0),
}
RECORDED_S = 1200.0  # of a recorded drive: 6,000 scans
_DRAWN = Path(__file__).resolve().parents[2] / 'worlds'
_ROBOT = PRESETS['2dx']
_SPEED_M_S = 0.5
_RECORDED_SEED = 0
# A robot that has not finished by then goes round in circles; the largest floor takes too long.
_LIMIT_S = 3000.0
_LIMITS_S = {LARGEST: 1200.0}
# What is cut short is not asked for its coverage, which takes long to prepare on a large floor.
_NOTHING = ObservableCells(np.zeros((0, 0), dtype=np.bool_), GridFrame(0.0, 0.0, 0.1))


def record_drive(world: str, worlds: Path, path: Path, limit_s: float = RECORDED_S) -> Numbers:
    """Record an exploration by the true pose, from a world's first start, into a file."""
    place, start = world_of(world, worlds)
    laser = LASERS['lms200']
    simulation = RecordedSimulation(place, start, _ROBOT, laser, _RECORDED_SEED)
    pipeline = Pipeline(_pipeline_config(laser), ground_truth_poses(simulation))
    loop = _closed_loop(simulation, pipeline)
    ending = loop.run(_NOTHING, limit_s, no_progress)
    recording = simulation.recording()
    recording.write(path)
    return {
        'scans': len(recording.stamps_ns),
        'distance_m': _length_m(recording.T_world_base),
        'reason': ending.reason,
        'collisions': ending.collisions,
    }


def measure_drive(
    case: DriveCase, recordings: Path, options: Numbers, scans_per_graph: int
) -> Numbers:
    """Numbers of a recorded drive with the odometry noise of the case's seed.

    scans_per_graph: as of the pipeline.
    """
    recording: Recording = read_recording(recordings / f'{flat(case.world)}.npz')
    truth = recording.T_world_base
    config = config_of(options, truth[0])
    samples = recording.replay(_ROBOT, case.odometry_seed)
    pairs = ((sample.scan, sample.T_odom_base) for sample in samples)
    return simulated_numbers(play(pairs, config, scans_per_graph), truth)


def measure_loop(case: LoopCase, worlds: Path, options: Numbers) -> Numbers:
    """Numbers of an exploration by the estimated pose."""
    world, start = world_of(case.world, worlds)
    laser = LASERS[case.laser]
    simulation = Simulation(world, start, _ROBOT, laser, case.seed)
    is_whole = case.world not in _LIMITS_S
    goal = robot_observable_cells(world, start, _ROBOT, laser.range_max_m) if is_whole else _NOTHING
    rehearse()
    pipeline = PlayedPipeline(_pipeline_config(laser, options, start))
    loop = _closed_loop(simulation, pipeline)
    forget_peak()
    ending = loop.run(goal, _LIMITS_S.get(case.world, _LIMIT_S), no_progress)
    played = pipeline.played
    played.final = pipeline.localizer.optimized_trajectory()
    played.peak_mb = peak_mb()
    truth = np.array(loop.log.true_poses)
    coverage = {'coverage': loop.log.coverage[-1][1]} if is_whole else {}
    return {
        **simulated_numbers(played, truth),
        **coverage,
        'collisions': ending.collisions,
        'finished': ending.finished,
        'reason': ending.reason,
        'distance_m': _length_m(truth),
        'time_s': played.stamps_ns[-1] / 1e9,
    }


def world_of(name: str, worlds: Path) -> tuple[World, Array]:
    """World and start (3,): FOLDER/NAME of the worlds with lists of starts, or a drawn one.

    Raises InputError where there is none of that name.
    """
    if '/' in name:
        for floor in floors(worlds, name):
            if floor.name == name:
                return floor.world, floor.starts[0]
        raise InputError(f'{worlds}: no world {name} in worlds.json')
    world = World.from_patch(*read_world(_DRAWN / f'{name}.yaml'))
    return world, world.start


def _pipeline_config(
    laser: LaserScannerConfig, options: Numbers | None = None, start: Array | None = None
) -> PipelineConfig:
    """As `explore_world` has it: a beam that met nothing has seen as far as this laser can."""
    return PipelineConfig(
        localizer=config_of(options or {}, start),
        grid=replace(PAPER_GRID, no_return_clear_range_m=laser.range_max_m),
        scans_per_graph=SCANS_PER_GRAPH,
    )


def _closed_loop(simulation: Simulation, pipeline: Pipeline) -> ClosedLoop:
    navigator = Navigator(NavigatorConfig(controller=PathFollowerConfig(max_speed_m_s=_SPEED_M_S)))
    strategy = make_strategy(DEFAULT, explorer_config(_ROBOT, _SPEED_M_S))
    return ClosedLoop(simulation, pipeline, strategy, navigator)


def _length_m(poses: Array) -> float:
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
