"""A log or bag through localizer, grid and topology, as fast as it goes.

Trajectory, map, graph, report and picture.
"""

import argparse
import json
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.occupancy import OccupancyConfig
from thinmap_ros.core.odometry import ScanPairing
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizer import ScanLocalizerConfig
from thinmap_ros.core.slam.localizers import line_features
from thinmap_ros.files import graphs as graph_files
from thinmap_ros.files import occupancy_maps as map_files
from thinmap_ros.files import trajectories as trajectory_files
from thinmap_ros.files.atomic import write_text, written_aside
from thinmap_ros.kernels.memory import give_back_pages, release_compiler_pages
from thinmap_ros.logs.log import Log, OdometryEvent
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.tools import cli
from thinmap_ros.tools.replay_view import ReplayView
from thinmap_ros.view import figures
from thinmap_ros.view.rerun_view import View


@dataclass(eq=False)
class Replay:
    """What came of a log: the pipeline at its end, and the pose (3,) of every scan."""

    pipeline: Pipeline
    stamps_ns: list[int] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    local_features: list[int] = field(default_factory=list)
    skipped: int = 0
    first_skipped: str = ''


def replay(
    log: Log, config: PipelineConfig, show_progress: bool = False, shown: ReplayView | None = None
) -> Replay:
    """Play a log through the pipeline, shown or not.

    Raises InputError where the log has nothing to play.
    """
    result = Replay(Pipeline(config))
    pairing = ScanPairing()
    tidy_up = give_back_pages()
    for event in tqdm(log.events(), unit=' events', disable=not show_progress):
        if isinstance(event, OdometryEvent):
            ready = pairing.add_odometry(event.stamp_ns, event.T_odom_base)
        else:
            ready = pairing.add_scan(event.scan)
        for scan, T_odom_base in ready:
            step = result.pipeline.step(scan, T_odom_base)
            result.stamps_ns.append(scan.stamp_ns)
            result.poses.append(step.estimate.T_map_base)
            result.local_features.append(step.estimate.n_local)
            if shown is not None:
                shown.step(scan, T_odom_base, step.estimate, result.pipeline)
        tidy_up()
    result.pipeline.finish()
    result.skipped = log.skipped.count + pairing.dropped + pairing.waiting
    result.first_skipped = log.skipped.first
    if not result.poses:
        raise InputError(f'no scan with odometry around its stamp; {result.skipped} skipped')
    if shown is not None:
        shown.last(result.stamps_ns[-1], result.pipeline)
    return result


def write_outputs(
    result: Replay, folder: Path, title: str, seconds: tuple[float, float]
) -> dict[str, Any]:
    """Write all files into a folder; seconds: wall and CPU time taken. Returns the report."""
    pipeline = result.pipeline
    patch = pipeline.grid.patch()
    poses = np.array(result.poses)
    folder.mkdir(parents=True, exist_ok=True)
    trajectory_files.write_tum(folder / 'trajectory.tum', result.stamps_ns, result.poses)
    final = list(pipeline.localizer.corrected_path())
    trajectory_files.write_tum(folder / 'trajectory_final.tum', result.stamps_ns, final)
    map_files.write_map(folder / 'map', patch)
    graph_files.write_geojson(folder / 'topology.geojson', pipeline.topology.map)
    release_compiler_pages()  # before matplotlib comes on top of them
    figures.summary_figure(folder / 'summary.png', patch, pipeline.topology.map, poses, title=title)
    report = _report(result, poses, seconds)
    write_text(folder / 'report.json', json.dumps(report, indent=2) + '\n')
    return report


def _report(result: Replay, poses: Array, seconds: tuple[float, float]) -> dict[str, Any]:
    stages = {name: np.array(taken) for name, taken in result.pipeline.stage_seconds.items()}
    rebuilds = stages.pop('rebuild', np.zeros(0))
    stages['all'] = np.sum(list(stages.values()), axis=0)
    return {
        'scans': len(poses),
        'skipped': result.skipped,
        'first_skipped': result.first_skipped,
        'wall_s': round(seconds[0], 3),
        'cpu_s': round(seconds[1], 3),
        'peak_mb': round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        'loops_closed': result.pipeline.corrections,
        'rebuild_ms': round(1000.0 * float(rebuilds.max(initial=0.0)), 1),
        'ms_per_scan': {name: _spread(1000.0 * taken) for name, taken in stages.items()},
        'features': len(line_features(result.pipeline.localizer)),
        'features_local_median': float(np.median(result.local_features)),
        'refused': result.pipeline.localizer.refused,
        'distance': round(float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()), 3),
        'nodes': len(result.pipeline.topology.map.nodes),
        'edges': len(result.pipeline.topology.map.edges),
    }


def _spread(milliseconds: Array) -> dict[str, float]:
    return {
        'median': round(float(np.median(milliseconds)), 3),
        'p95': round(float(np.percentile(milliseconds, 95)), 3),
        'max': round(float(milliseconds.max()), 3),
    }


def _work(arguments: argparse.Namespace) -> None:
    with _view(arguments) as view:
        _play(arguments, None if view is None else ReplayView(view))
        if view is not None and arguments.view:
            print('close the viewer to end', file=sys.stderr)
            view.wait_until_closed()


@contextmanager
def _view(arguments: argparse.Namespace) -> Iterator[View | None]:
    """What is asked for of viewer and recording.

    Of a log that cannot be replayed there is no recording.
    """
    if not (arguments.view or arguments.recording):
        yield None
        return
    with ExitStack() as stack:
        aside = (
            stack.enter_context(written_aside(arguments.recording)) if arguments.recording else None
        )
        view = View(aside, arguments.view)
        stack.callback(view.close)
        yield view


def _play(arguments: argparse.Namespace, shown: ReplayView | None) -> None:
    config = PipelineConfig(
        localizer=cli.config_from(arguments, ScanLocalizerConfig),
        grid=cli.config_from(arguments, OccupancyConfig),
    )
    wall = time.perf_counter()
    cpu = time.process_time()
    result = replay(cli.open_log(arguments), config, show_progress=not arguments.quiet, shown=shown)
    seconds = (time.perf_counter() - wall, time.process_time() - cpu)
    title = f'{arguments.log.name}: {len(result.poses)} scans'
    report = write_outputs(result, arguments.out, title, seconds)
    skipped = f', {result.skipped} skipped' if result.skipped else ''
    if result.first_skipped:
        skipped += f' (first: {result.first_skipped})'
    print(
        f'{arguments.out}: {report["scans"]} scans{skipped}, {report["distance"]:.1f} m, '
        f'{report["ms_per_scan"]["all"]["median"]:.1f} ms a scan'
    )


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(prog='replay', description=__doc__)
    cli.add_log_options(parser)
    parser.add_argument('-o', '--out', type=Path, required=True, help='folder for the results')
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    parser.add_argument(
        '--view', action='store_true', help='show it in rerun, until the viewer is closed'
    )
    parser.add_argument('--recording', type=Path, help="file for rerun's recording (.rrd)")
    cli.add_config(parser, ScanLocalizerConfig, ['slam'])
    cli.add_config(parser, OccupancyConfig, ['resolution_m', 'no_return_range_m', 'usable_range_m'])
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
