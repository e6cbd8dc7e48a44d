"""Makes pieces of map: halves of logs, and simulated explorations, each from its own origin."""

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.places.recorded import RecordedPiece
from thinmap_ros.closed_loop import SCANS_PER_GRAPH, ClosedLoop, Mishap, no_progress
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.planning.navigator import Navigator, NavigatorConfig
from thinmap_ros.core.planning.path_follower import PathFollowerConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.files.worlds import read_world
from thinmap_ros.logs.reading import open_log, paired_scans
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.sim.coverage import ObservableCells
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.simulation import Simulation
from thinmap_ros.sim.world import World
from thinmap_ros.strategies import make_strategy

_SPEED_M_S = 0.5
_SCANS_PER_GRAPH = 10  # of logs
_NO_GOAL = ObservableCells(np.zeros((0, 0), dtype=np.bool_), GridFrame(0.0, 0.0, 0.1))
HALVES = ('a', 'b')


def make_halves(logs: Path, name: str, folder: Path) -> None:
    """Make the pieces NAME.a and NAME.b of the halves of a log.

    The truth is the trajectory of the whole log after all corrections, where the robot is in the
    published map.
    """
    if all((folder / f'{name}.{half}.npz').exists() for half in HALVES):
        return
    paths = (logs / name / 'log.clf.gz', logs / name / 'log.clf')
    pairs = list(paired_scans(open_log(next(path for path in paths if path.exists()))))
    _, truth = _mapped(pairs)
    middle = len(pairs) // 2
    for half, some in zip(HALVES, (pairs[:middle], pairs[middle:]), strict=True):
        pipeline, _ = _mapped(some)
        _recorded(f'{name}.{half}', pipeline, truth).save(folder)


def make_exploration(worlds: Path, name: str, start: int, folder: Path, limit_s: float) -> None:
    """Make the piece NAME.sSTART of an exploration from a start of a world, for so many seconds."""
    piece = f'{name.replace("/", "_")}.s{start}'
    if (folder / f'{piece}.npz').exists():
        return
    starts = json.loads((worlds / 'worlds.json').read_text(encoding='utf-8'))[name]['starts']
    world = World.from_patch(*read_world(worlds / f'{name}.yaml'))
    pipeline, truth = explored(world, np.array(starts[start]), start, limit_s)
    _recorded(piece, pipeline, truth).save(folder)


def explored(
    world: World, start: Array, seed: int, limit_s: float, watcher: Mishap | None = None
) -> tuple[Pipeline, dict[int, Array]]:
    """Explore a world from a start (3,), with SLAM from an origin of its own.

    watcher: of each scan. Returns the pipeline, and the true pose (3,) by the stamp of each scan.
    """
    laser = LaserScannerConfig()
    simulation = Simulation(world, start, PRESETS['2dx'], laser, seed)
    grid = replace(PAPER_GRID, no_return_clear_range_m=laser.range_max_m)
    pipeline = Pipeline(PipelineConfig(grid=grid, scans_per_graph=SCANS_PER_GRAPH))
    controller = PathFollowerConfig(max_speed_m_s=_SPEED_M_S)
    navigator = Navigator(NavigatorConfig(controller=controller))
    strategy = make_strategy('nearest_frontier')
    loop = ClosedLoop(simulation, pipeline, strategy, navigator, watcher)
    loop.run(_NO_GOAL, limit_s, no_progress, scans_per_show=10**9)
    pipeline.localizer.optimized_trajectory()
    return pipeline, dict(zip(loop.log.stamps_ns, loop.log.true_poses, strict=True))


def _mapped(pairs: Iterable[tuple[Scan, Array]]) -> tuple[Pipeline, dict[int, Array]]:
    """Map scans with their odometry; returns the corrected poses (3,) by stamp, too."""
    pipeline = Pipeline(PipelineConfig(grid=PAPER_GRID, scans_per_graph=_SCANS_PER_GRAPH))
    stamps = []
    for scan, T_odom_base in pairs:
        estimate = pipeline.step(scan, T_odom_base).estimate
        stamps.append(None if estimate.is_mapping_apart else scan.stamp_ns)
    pipeline.finish()
    poses = pipeline.localizer.optimized_trajectory()
    return pipeline, {s: T for s, T in zip(stamps, poses, strict=True) if s is not None}


def _recorded(name: str, pipeline: Pipeline, truth: dict[int, Array]) -> RecordedPiece:
    localizer = pipeline.localizer
    assert isinstance(localizer, Localizer)
    frames = localizer.keyframes
    unknown = np.full(3, np.nan)
    poses = np.array([truth.get(frame.scan.stamp_ns, unknown) for frame in frames])
    return RecordedPiece(
        name,
        frames,
        localizer.edges,
        pipeline.grid.known_area(),
        pipeline.topology.map,
        poses,
    )
