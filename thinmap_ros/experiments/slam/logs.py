"""Logs of real robots: map, graph, features, trajectory, and errors where relations are known."""

import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.core.errors import ConfigError, InputError, one_line_reason
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.evaluation import slam_run
from thinmap_ros.evaluation.outcome import Comparison, Outcome, Table
from thinmap_ros.evaluation.trajectory_errors import RelationErrors, read_columns, relation_errors
from thinmap_ros.files.safe import read_mapping
from thinmap_ros.logs.log import LaserOptions
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.pipeline import PipelineConfig
from thinmap_ros.replaying import Replay, replay, write_outputs
from thinmap_ros.view.plots import Curve, GraphLayer, MapLayer, Panel, Plot

# Lasers of known logs, by the folder's name; a file laser.yaml in a log's folder comes before.
_LASERS = {
    'sena': {'offset_m': 0.78},
    'mrpt_office': {
        'offset_m': 0.16,
        'start_angle_deg': -110.0079,
        'step_deg': 0.352025,
        'range_max_m': 25.0,
    },
}
_COLUMNS = [
    'log',
    'scans',
    'skipped',
    'way_m',
    'features',
    'features_local',
    'nodes',
    'edges',
    'loops',
    'live_m',
    'live_deg',
    'final_m',
    'final_deg',
    'odometry_m',
]


@dataclass(frozen=True, eq=False)
class _Result:
    """Of one log: its row of numbers, its row of times, and its figure."""

    row: list[Any]
    timed: list[Any]
    plot: Plot


def run(folder: Path, out: Path) -> Outcome:
    """Replay each folder with a log.clf in a process of its own; its files go to out/NAME."""
    names = sorted(path.parent.name for path in folder.glob('*/log.clf'))
    if not names:
        raise InputError(f'{folder}: no NAME/log.clf in it: expected folders with logs')
    results = []
    for name in names:
        # A process of its own: the memory that it took at the most is then that of this log.
        with ProcessPoolExecutor(1, mp_context=get_context('spawn')) as pool:
            results.append(pool.submit(_one, folder / name, out / name).result())
    rows = [result.row for result in results]
    return Outcome(
        'Logs of real robots',
        'Logs recorded with SICK lasers',
        'Localizer, grid and topological map process each log in file order. '
        'Live: the estimate at the time of a scan; final: after all corrections. '
        'Errors are means over the reference relations between poses, of translation and rotation. '
        'The column *paper* has errors of other programs: [Peers](peers.md).',
        [
            Table('logs', _COLUMNS, rows),
            Table('others', _OTHER_COLUMNS, [_other(run) for run in slam_run.runs(slam_run.INTEL)]),
            Table('times', _TIMED, [result.timed for result in results], timed=True),
        ],
        [result.plot for result in results],
        [comparison for row in rows for comparison in _comparisons(row)],
    )


_OTHER_COLUMNS = ['system', 'log', 'live_m', 'final_m', 'cpu_ms_per_scan', 'peak_mb', 'origin']
_TIMED = ['log', 'cpu_ms_per_scan', 'wall_ms_median', 'wall_ms_p95', 'wall_ms_max', 'peak_mb']


def _one(folder: Path, out: Path) -> _Result:
    wall = time.perf_counter()
    cpu = time.process_time()
    result = replay(
        CarmenLog(folder / 'log.clf', laser_of(folder, folder.name)),
        PipelineConfig(grid=PAPER_GRID),
    )
    seconds = (time.perf_counter() - wall, time.process_time() - cpu)
    report = write_outputs(result, out, folder.name, seconds)
    ms = report['ms_per_scan']['all']
    cpu_ms = 1000.0 * seconds[1] / report['scans']
    timed = [folder.name, cpu_ms, ms['median'], ms['p95'], ms['max'], report['peak_mb']]
    keys = (
        'scans',
        'skipped',
        'distance',
        'features',
        'features_local_median',
        'nodes',
        'edges',
        'loops_closed',
    )
    row = [folder.name, *(report[key] for key in keys), *_errors(folder, result)]
    return _Result(row, timed, _plot(folder, result))


def laser_of(folder: Path, log: str) -> LaserOptions:
    """Options of the laser: those of laser.yaml in the folder, or of a known log of that name.

    Raises InputError where it is bad.
    """
    path = folder / 'laser.yaml'
    options = _LASERS.get(log, {})
    if path.exists():
        options = read_mapping(path, 'options of the laser')
    try:
        return LaserOptions(**options)
    except (TypeError, ConfigError) as error:
        raise InputError(f'{path}: {one_line_reason(error)}') from error


def _errors(folder: Path, result: Replay) -> list[float | None]:
    """Errors by relations: live m, deg, final m, deg, raw odometry m; None without relations."""
    relations = folder / 'relations'
    odometry = folder / 'odom.txt'
    if not relations.exists():
        return [None] * 5
    times = np.array(result.stamps_ns) / 1e9
    wheels = read_columns(odometry, [0, 1, 2, 3])
    paths = [
        (times, np.array(result.poses)),
        (times, result.pipeline.localizer.optimized_trajectory()),
    ]
    live, final = (relation_errors(*path, relations, odometry) for path in paths)
    raw = relation_errors(wheels[:, 0], wheels[:, 1:], relations, odometry)
    return [*_means(live), *_means(final), float(raw.metres.mean())]


def _means(errors: RelationErrors) -> tuple[float, float]:
    return float(errors.metres.mean()), float(errors.degrees.mean())


def _plot(folder: Path, result: Replay) -> Plot:
    pipeline = result.pipeline
    graph = result.pipeline.topology.map
    patch = pipeline.grid.known_area()
    final = pipeline.localizer.optimized_trajectory()
    trajectory = Curve(final[:, :2], 'trajectory', 3, width=1.0)
    rows, cols = patch.shape
    width = min(7.0, 6.0 * cols / rows)
    return Plot(
        folder.name,
        f'{folder.name}: map and trajectory; topological map.',
        [
            Panel([MapLayer(patch), trajectory], 'map and trajectory'),
            Panel([MapLayer(patch), GraphLayer(graph, 3.0)], f'{len(graph.nodes)} nodes'),
        ],
        columns=2,
        panel_inches=(width, min(6.0, width * rows / cols + 0.8)),
    )


def _comparisons(row: list[Any]) -> list[Comparison]:
    """The errors of a log whose relations are known, beside those of others where there are any."""
    values = dict(zip(_COLUMNS, row, strict=True))
    if values['final_m'] is None:
        return []
    name = values['log']
    ours = f'{values["final_m"]:.3f} m final, {values["live_m"]:.3f} m live'
    degrees = (
        f'{values["final_deg"]:.2f} deg, live {values["live_deg"]:.2f} deg; '
        f'odometry {values["odometry_m"]:.2f} m'
    )
    rows = [Comparison(f'{name}: mean error', '', ours, remark=degrees)]
    if name == slam_run.INTEL:
        rows += [_against(run, values) for run in slam_run.runs(name)]
    return rows


def _other(run: slam_run.PeerRun) -> list[Any]:
    errors = [slam_run.shown(run.live_m), slam_run.shown(run.final_m)]
    return [run.system, run.log, *errors, run.cpu_ms, run.peak_mb, run.origin.value]


def _against(run: slam_run.PeerRun, values: dict[str, Any]) -> Comparison:
    """Errors beside those of another program: ours are as good if each is at most its lowest."""
    pairs = [('final', run.final_m), ('live', run.live_m)]
    known = [(name, metres) for name, metres in pairs if metres is not None]
    theirs = ', '.join(f'{slam_run.shown(metres)} m {name}' for name, metres in known)
    ours = ', '.join(f'{values[f"{name}_m"]:.3f} m {name}' for name, _ in known)
    better = all(values[f'{name}_m'] <= metres[0] for name, metres in known)
    what = f'intel, against {run.system}' + (f' ({run.note})' if run.note else '')
    return Comparison(what, theirs, ours, better, remark=run.origin.value)
