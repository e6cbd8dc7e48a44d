"""Replays logs or bags through localizer, grid and topology, as fast as possible."""

import argparse
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, ThinmapError
from thinmap_ros.core.grid.occupancy import OccupancyConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.slam.localizer import default_config
from thinmap_ros.core.stage import Estimate, StartConfig, config_at
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.evaluation.batch import REASON, Batch, FileJob, jobs_of, reported, run_batch
from thinmap_ros.evaluation.parallel_jobs import Report, add_run_options
from thinmap_ros.files.safe import atomic_write, read_text
from thinmap_ros.files.sessions import GRID, require_own_files, stem_of
from thinmap_ros.logs.log import Event, Log, SkippedRecords, known_formats
from thinmap_ros.logs.transforms import parse_pose
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.replaying import Replay, Watcher, replay, write_outputs
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser, add_out, check_place, out_folder
from thinmap_ros.tools.parameter_file import NodeParameters, read_parameter_file
from thinmap_ros.view.interface import NullView
from thinmap_ros.view.rerun_view import View

# Whose parameters replay takes from a file.
_NODES = ('localizer', 'grid_mapper', 'topology_builder')
_OF_ONE = ('view', 'recording', 'session', 'continued', 'start')  # expect one log
# Arguments that do not decide about the result.
_ASIDE = ('logs', 'out', 'jobs', 'dask', 'quiet', 'graph_period_s', *_OF_ONE, 'command')
_COLUMNS = ('scans', 'distance_m', 'cpu_ms_per_scan', 'loops', 'lost', 'apart')
Opened = Callable[[Log], AbstractContextManager[Any]]


def replay_log(
    path: Path,
    out: Path,
    arguments: argparse.Namespace,
    shown: Watcher | None = None,
    opened: Opened = nullcontext,
) -> tuple[Replay, dict[str, Any]]:
    """Replay a log with the arguments of `replay`; returns the result and the report.

    All files are written to out. opened: makes a context manager of the log, for its time.
    """
    parameters = _parameters(arguments)
    config = _config(arguments, parameters)
    if arguments.session and not config.localizer.is_mapping:
        raise InputError(f'--session {arguments.session}: expected mode: mapping, not localization')
    wall = time.perf_counter()
    cpu = time.process_time()
    with opened(cli.open_log(path, arguments, parameters)) as log:
        result = replay(
            log,
            config,
            show_progress=not arguments.quiet,
            watcher=shown,
            keep_partial=True,
            continued=arguments.continued,
        )
    if arguments.session:
        result.session = str(stem_of(arguments.session))
        for line in result.pipeline.save_session(result.session):
            print(line)
    result.notes = [*parameters.notes, *result.notes]
    seconds = (time.perf_counter() - wall, time.process_time() - cpu)
    title = f'{path.name}: {len(result.poses)} scans'
    return result, write_outputs(result, out, title, seconds, arguments.command)


def options_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """The arguments that decide about results, by name, with the text of the parameter file."""
    options = {name: value for name, value in vars(arguments).items() if name not in _ASIDE}
    file = options.pop('params_file')
    return {**options, 'parameters': read_text(file) if file else ''}


def run_job(job: FileJob) -> Report:
    """Replay one of many logs into its folder."""
    arguments = argparse.Namespace(**job.arguments)
    _, report = replay_log(job.path, job.folder, arguments)
    reasons = [report['ended_by'], *report['warnings']]
    return reported(
        job,
        {
            'scans': report['scans'],
            'distance_m': round(report['distance'], 1),
            'cpu_ms_per_scan': report['cpu_ms_per_scan'],
            'loops': report['loops_closed'],
            'lost': report['lost'],
            'apart': report['apart'],
            REASON: '; '.join(filter(None, reasons)),
        },
    )


BATCH = Batch(run_job, _COLUMNS, 'Replayed logs')


def _parameters(arguments: argparse.Namespace) -> NodeParameters:
    """Parameters of the file; `slam` of the command line comes before that of the file."""
    slam = getattr(arguments, 'slam', '')
    file = arguments.params_file
    if file:
        return read_parameter_file(file, _NODES, slam)
    return NodeParameters({'localizer': {'slam': slam or StartConfig.slam}})


def _config(arguments: argparse.Namespace, parameters: NodeParameters) -> PipelineConfig:
    """Parameters of all stages: those of the command line come before those of a file."""
    slam = parameters.value('localizer', 'slam', StartConfig.slam)
    grid = parameters.config('grid_mapper', OccupancyConfig())
    localizer = parameters.config('localizer', default_config(slam))
    if arguments.start:
        localizer = config_at(localizer, parse_pose(arguments.start, '--start', 'X,Y,YAW'))
    return PipelineConfig(
        localizer=localizer,
        grid=cli.config_from(arguments, OccupancyConfig, grid),
        topology=parameters.config('topology_builder', TopologyConfig()),
    )


# Large data are converted once a second: a view does not draw them more often.
_PERIOD_NS = 1_000_000_000
_STAGES = {'localizer': 'localizer', 'grid': 'map update'}


class ReplayView:
    """Shows the results of a pipeline in a view, as of live nodes; `finish` shows the final map."""

    def __init__(self, view: NullView, graph_period_s: float = 0.0) -> None:
        """Start with an empty view; graph_period_s: from one graph to the next, 0: at the end."""
        self._view = view
        self._T_map_odom: Array | None = None
        self._drawn_ns: int | None = None
        self._graph_period_ns = graph_period_s * SECOND_NS
        self._graph_ns: int | None = None

    def step(self, scan: Scan, T_odom_base: Array, estimate: Estimate, pipeline: Pipeline) -> None:
        """Show the result of a scan with the odometry pose (3,) at its stamp."""
        ns = scan.stamp_ns
        view = self._view
        view.pose(ns, estimate.T_map_base, estimate.covariance)
        view.scan(ns, scan)
        if self._T_map_odom is None:
            self._T_map_odom = estimate.T_map_odom
        # Dead reckoning from the first pose.
        view.trajectory(ns, 'odometry', se2.compose(self._T_map_odom, T_odom_base))
        view.scalar(ns, 'error', '2 sigma, cm', 200.0 * se2.sigma_m(estimate.covariance))
        for curve, count in (
            ('features', estimate.n_features),
            ('local features', estimate.n_local_features),
            ('matched lines', estimate.matched_lines),
        ):
            view.scalar(ns, 'count', curve, float(count))
        for stage, curve in _STAGES.items():
            view.scalar(ns, 'step', curve, 1000.0 * pipeline.stage_seconds[stage][-1])
        if self._drawn_ns is None or abs(ns - self._drawn_ns) >= _PERIOD_NS:
            self._show_map(ns, pipeline)
        last_ns = self._graph_ns
        if self._graph_period_ns and (
            last_ns is None or abs(ns - last_ns) >= self._graph_period_ns
        ):
            self._show_graph(ns, pipeline)

    def finish(self, ns: int, pipeline: Pipeline) -> None:
        """Show map, graph and features as they are now."""
        self._show_map(ns, pipeline)
        self._show_graph(ns, pipeline)

    def _show_graph(self, ns: int, pipeline: Pipeline) -> None:
        self._graph_ns = ns
        topology = pipeline.topology.map
        self._view.topology(ns, topology)
        self._view.scalar(ns, 'count', 'nodes', float(len(topology.nodes)))

    def _show_map(self, ns: int, pipeline: Pipeline) -> None:
        self._drawn_ns = ns
        view = self._view
        view.grid(ns, pipeline.grid.known_area())
        view.apart(ns, pipeline.localizer.apart_points())
        features = pipeline.localizer.features
        if not features:
            return  # only a filter has them, and the graph at every scan
        topology = pipeline.topology.map
        ends = np.array([[feature.start, feature.end] for feature in features]).reshape(-1, 2, 2)
        view.lines(ns, ends, np.array([feature.local for feature in features], dtype=bool))
        near = {node for feature in features if feature.local for node in feature.nodes}
        places = [topology.nodes[node].position for node in sorted(near & topology.nodes.keys())]
        view.local_area(ns, np.array(places).reshape(-1, 2))


def _work(arguments: argparse.Namespace) -> None:
    arguments.command = cli.command_line()
    is_one = len(arguments.logs) == 1
    arguments.out = out_folder(arguments.out, arguments.logs[0].stem if is_one else 'logs')
    if arguments.recording:
        check_place(arguments.recording)
    if arguments.session:
        check_place(stem_of(arguments.session))
        require_own_files(arguments.session, GRID)  # report a wrong name before the work
    if arguments.start and not arguments.continued:
        raise InputError(f'--start {arguments.start}: expected --continue, in whose map it is')
    if not arguments.graph_period_s >= 0.0:
        raise InputError(f'--graph-period-s {arguments.graph_period_s:g}: expected 0 or more')
    if len(arguments.logs) > 1:
        _replay_many(arguments)
    else:
        _replay_one(arguments)


def _replay_one(arguments: argparse.Namespace) -> None:
    with _view(arguments) as view:
        shown = None if view is None else ReplayView(view, arguments.graph_period_s)
        result = _play(arguments, shown)
        if view is not None and arguments.view and result.ended_by is None:
            print('close the viewer to end', file=sys.stderr)
            view.wait_until_closed()
    if isinstance(result.ended_by, ThinmapError | OSError):
        written = f'the {len(result.poses)} scans before it are in {arguments.out}'
        raise InputError(f'{result.ended_by}; {written}') from result.ended_by
    if result.ended_by is not None:
        raise result.ended_by


@contextmanager
def _view(arguments: argparse.Namespace) -> Iterator[View | None]:
    """The requested viewer and recording. It is deleted if nothing was replayed."""
    if not (arguments.view or arguments.recording):
        yield None
        return
    with ExitStack() as stack:
        aside = (
            stack.enter_context(atomic_write(arguments.recording)) if arguments.recording else None
        )
        view = View(aside, arguments.view)
        stack.callback(view.close)
        yield view


class _InterruptibleLog:
    """A log that ends after a whole event once it is interrupted."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._is_interrupted = False

    @property
    def skipped(self) -> SkippedRecords:
        """Unusable records of the log."""
        return self._log.skipped

    @property
    def expected_scans(self) -> int | None:
        """Expected number of scans of the log."""
        return self._log.expected_scans

    @property
    def is_sorted(self) -> bool:
        """Whether the order of the file is right."""
        return self._log.is_sorted

    def events(self) -> Iterator[Event]:
        """Events of the log; raises KeyboardInterrupt between two of them."""
        for event in self._log.events():
            if self._is_interrupted:
                raise KeyboardInterrupt
            yield event

    def interrupt(self, number: int, frame: FrameType | None) -> None:
        """End after this event; the second time at once."""
        if self._is_interrupted:
            raise KeyboardInterrupt
        self._is_interrupted = True


@contextmanager
def _interruptible(log: Log) -> Iterator[_InterruptibleLog]:
    """The log, which Ctrl-C and SIGTERM end after a whole event: the results are consistent."""
    interruptible = _InterruptibleLog(log)
    signals = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, interruptible.interrupt) for number in signals]
    try:
        yield interruptible
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)


def _play(arguments: argparse.Namespace, shown: ReplayView | None) -> Replay:
    (path,) = arguments.logs
    result, report = replay_log(path, arguments.out, arguments, shown, _interruptible)
    print(f'{arguments.out}: {_summary(result, report)}')
    _print_notes(result)
    return result


def _replay_many(arguments: argparse.Namespace) -> None:
    """Replay several logs, each into a folder of its own."""
    if any(getattr(arguments, name) for name in _OF_ONE):
        raise InputError('--view, --recording, --session, --continue: expected one log')
    # A job shows no bar of its own.
    jobs = jobs_of(
        arguments.logs, arguments.out, options_of(arguments), {**vars(arguments), 'quiet': True}
    )
    run_batch(BATCH, jobs, arguments)


def _summary(result: Replay, report: dict[str, Any]) -> str:
    """Counts, distance and time in one line."""
    counts = result.counts
    parts = [f'{report["scans"]} scans{_bracketed(counts.unmapped())}']
    if result.skipped:
        first = [f'first: {result.first_skipped}'] if result.first_skipped else []
        parts.append(f'{result.skipped} skipped{_bracketed(counts.unpaired() + first)}')
    if report['refused']:
        parts.append(f'{report["refused"]} not mapped (first: {report["first_refused"]})')
    parts += [
        f'{report["distance"]:.1f} m',
        f'{report["cpu_ms_per_scan"]:.1f} ms of CPU a scan',
    ]
    return ', '.join(parts)


def _bracketed(reasons: list[str]) -> str:
    return f' ({"; ".join(reasons)})' if reasons else ''


def _print_notes(result: Replay) -> None:
    """Notes, warnings, and loudly that most of the scans were not used."""
    for note in result.notes:
        print(f'replay: note: {note}', file=sys.stderr)
    for warning in result.warnings:
        print(f'replay: warning: {warning}', file=sys.stderr)
    unused = result.counts.unused
    scans = len(result.poses) + sum(result.counts.without_odometry.values())
    if 2 * unused > scans:
        reasons = '; '.join(result.counts.unpaired() + result.counts.unmapped())
        if result.continued and result.counts.lost:
            reasons += f'; --start X,Y,YAW: where in {result.continued} it starts'
        print(
            f'replay: warning: only {scans - unused} of {scans} scans were used: {reasons}',
            file=sys.stderr,
        )


def main() -> None:
    """Run the program."""
    parser = Parser('replay', __doc__)
    parser.add_argument(
        'logs',
        type=Path,
        nargs='+',
        metavar='LOG',
        help=f'a log: {known_formats()}. Of several, each has a folder of its own below OUT, and '
        'summary.csv and report.html there are over all; what is done is not done again',
    )
    cli.add_log_options(parser)
    add_out(parser, 'out/LOG; of several logs out/logs')
    add_run_options(parser)
    parser.add_argument(
        '--params-file',
        type=Path,
        help='parameter file of the nodes, such as config/robots/turtlebot4.yaml; options come '
        'before it',
    )
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    parser.add_argument(
        '--view', action='store_true', help='show it in rerun, until the viewer is closed'
    )
    parser.add_argument('--recording', type=Path, help="file for rerun's recording (.rrd)")
    parser.add_argument(
        '--graph-period-s',
        type=float,
        default=0.0,
        metavar='S',
        help='with --view or --recording: show the graph as it grows, once in so many seconds of '
        'the log (default 0: at the end, which takes much less time)',
    )
    parser.add_argument(
        '--session',
        default='',
        metavar='STEM',
        help='save map, graph and keyframes as a session, for --continue, merge_sessions and '
        'session_path of the nodes; one of that name is replaced',
    )
    parser.add_argument(
        '--continue',
        dest='continued',
        default='',
        metavar='SESSION',
        help='continue in the map of a session (path STEM) or of map_server (YAML file), which '
        'stays as it is unless --session names it, too',
    )
    parser.add_argument(
        '--start',
        default='',
        metavar='X,Y,YAW',
        help='with --continue: where the robot starts in that map, m, m, rad (default 0,0,0: where '
        'the session began, which is believed once scans fit along 6 m of path)',
    )
    cli.add_config(parser, StartConfig, ['slam'])
    cli.add_config(parser, OccupancyConfig, ['resolution_m', 'no_return_clear_range_m'])
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
