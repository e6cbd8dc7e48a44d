"""Replays the log that a command line names, here or as one of many jobs."""

import argparse
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from thinmap_ros.core.grid.occupancy import OccupancyConfig
from thinmap_ros.core.slam.localizer import default_config
from thinmap_ros.core.stage import StartConfig
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.evaluation.batch import REASON, Batch, FileJob, reported
from thinmap_ros.evaluation.parallel_jobs import Report
from thinmap_ros.files.safe import read_text
from thinmap_ros.logs.log import Log
from thinmap_ros.pipeline import PipelineConfig
from thinmap_ros.replaying import Replay, Watcher, replay, write_outputs
from thinmap_ros.tools import cli
from thinmap_ros.tools.parameter_file import NodeParameters, read_parameter_file

# Whose parameters replay takes from a file.
_NODES = ('localizer', 'grid_mapper', 'topology_builder')
# Arguments that do not decide about the result.
_ASIDE = ('logs', 'out', 'jobs', 'dask', 'quiet', 'view', 'recording', 'command')
_COLUMNS = ('scans', 'distance_m', 'ms_per_scan', 'loops', 'lost', 'apart')

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
    wall = time.perf_counter()
    cpu = time.process_time()
    with opened(cli.open_log(path, arguments, parameters)) as log:
        result = replay(
            log, config, show_progress=not arguments.quiet, watcher=shown, keep_partial=True
        )
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
            'ms_per_scan': report['ms_per_scan']['all']['median'],
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
    return PipelineConfig(
        localizer=parameters.config('localizer', default_config(slam)),
        grid=cli.config_from(arguments, OccupancyConfig, grid),
        topology=parameters.config('topology_builder', TopologyConfig()),
    )
