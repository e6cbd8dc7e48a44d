"""Results of a run of the live graph, from its bag."""

import sys
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.closed_loop import ExplorationOutcome
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.belief import MissingArea
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap, topology_from_msg
from thinmap_ros.evaluation.exploration_metrics import (
    EndNodeCensus,
    exploration_report,
    exploration_title,
    hidden_places,
    missing_area_report,
)
from thinmap_ros.files.worlds import read_world
from thinmap_ros.logs import decode
from thinmap_ros.logs.readers.bag import Bag
from thinmap_ros.sim.coverage import ObservableCells, robot_observable_cells
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World
from thinmap_ros.view import rerun_sinks
from thinmap_ros.view.message_view import recording_from_bag
from thinmap_ros.view.run_folder import RunResult, write_report, write_run

FILES = (
    'map.pgm',
    'map.yaml',
    'topology.geojson',
    'trajectory.tum',
    'report.json',
    'report.html',
    'summary.png',
    'recording.rrd',
)
_TOPICS = (
    'ground_truth',
    'pose',
    'map',
    'map_updates',
    'topology',
    'end_nodes',
    'exploration_status',
    'collisions',
    'scan',
)


@dataclass(eq=False)
class Recording:
    """The outputs of a run: paths by stamp, maps by stamp, the last graph, end nodes, contacts.

    hidden: position, m, and expected hidden area, m2, of each end node at the end; missing: area.
    """

    true: dict[int, Array] = field(default_factory=dict)
    estimated: dict[int, Array] = field(default_factory=dict)
    maps: list[tuple[int, GridPatch]] = field(default_factory=list)
    topology: TopologicalMap = field(default_factory=TopologicalMap)
    end_nodes: list[tuple[int, list[tuple[int, float, float]]]] = field(default_factory=list)
    hidden: list[tuple[float, float, float]] = field(default_factory=list)
    missing: MissingArea | None = None
    collisions: int = 0
    range_max_m: float = 8.0


def read(path: Path, prefix: str = '/') -> Recording:
    """Read the outputs from the bag of a run; prefix: of the topics of one of several robots.

    Raises InputError if a topic is missing.
    """
    bag = Bag(path)
    recording = Recording()
    known = MapReceiver()
    for raw in bag.messages({f'{prefix}{name}' for name in _TOPICS}):
        message = bag.decode(raw)
        topic = raw.topic.removeprefix(prefix)
        if topic == 'collisions':
            recording.collisions = int(message.data)
            continue
        ns = decode.stamp_ns(message)
        if topic == 'ground_truth':
            recording.true[ns] = decode.pose(message.pose)
        elif topic == 'pose':
            recording.estimated[ns] = decode.pose(message.pose.pose)
        elif topic in ('map', 'map_updates'):
            recording.maps += [(ns, patch) for patch in _known_map(known, ns, message)]
        elif topic == 'topology':
            recording.topology = recorded_topology(path, raw.topic, message)
        elif topic == 'end_nodes':
            nodes = [(int(n.node_id), n.position.x, n.position.y) for n in message.end_nodes]
            recording.end_nodes.append((ns, nodes))
            recording.hidden = [
                (n.position.x, n.position.y, float(n.expected_area_m2)) for n in message.end_nodes
            ]
        elif topic == 'exploration_status':
            recording.missing = _missing_area(message)
        else:
            recording.range_max_m = float(message.range_max)
    if not (recording.true and recording.estimated and recording.maps):
        raise InputError(
            f'{path}: expected {prefix}ground_truth, {prefix}pose and {prefix}map; '
            f'it has {", ".join(sorted(bag.topics))}'
        )
    return recording


def _known_map(known: MapReceiver, ns: int, message: Any) -> list[GridPatch]:
    """The map after a whole map or an update; empty where that does not change it."""
    is_new = True
    if hasattr(message, 'info'):
        known.replace(decode.patch(message), ns)
    else:
        with suppress(InputError):  # of a map that is not in the bag
            is_new = known.update(ns, *decode.map_update(message))
    return [known.patch] if is_new and known.patch is not None else []


def recorded_topology(path: Path, topic: str, message: Any) -> TopologicalMap:
    """Topological map of a message. Raises InputError, with path and topic, if it is invalid."""
    try:
        return topology_from_msg(message)
    except InputError as error:
        raise InputError(f'{path}: {topic}: {error}') from error


def _missing_area(message: Any) -> MissingArea | None:
    areas = (float(message.missing_area_m2), float(message.missing_area_bound_m2))
    return MissingArea(*areas) if min(areas) >= 0.0 else None


def write(
    out: Path, world_file: Path, robot: str, result: dict[str, Any], command: str = ''
) -> dict[str, Any]:
    """Write map, graph, trajectory, picture, report and, with rerun, recording of a run in out/bag.

    Returns the report.
    """
    recording = read(out / 'bag')
    world = World.from_patch(*read_world(world_file))
    start = next(iter(recording.true.values()))
    seen = robot_observable_cells(world, start, PRESETS[robot], recording.range_max_m)
    report = _report(recording, seen, result) | {'world': world.name}
    title = exploration_title(report)
    estimated = np.array(list(recording.estimated.values()))
    true = np.array(list(recording.true.values()))
    run = RunResult(
        recording.maps[-1][1],
        recording.topology,
        title,
        {'trajectory': (list(recording.estimated), list(estimated))},
        estimated,
        {'true': true, 'hidden': hidden_places(report)},
    )
    write_run(out, run)
    if rerun_sinks.is_installed():
        recording_from_bag(out / 'bag', out / 'recording.rrd')
    else:
        print(f'no recording.rrd: {rerun_sinks.ADVICE}', file=sys.stderr)
    write_report(out, title, report, command)
    return report


def _report(recording: Recording, seen: ObservableCells, result: dict[str, Any]) -> dict[str, Any]:
    start_ns = int(result['start_ns'])
    end_ns = int(result['end_ns'])
    stamps = [ns for ns in recording.true if start_ns <= ns <= end_ns and ns in recording.estimated]
    true = np.array([recording.true[ns] for ns in stamps])
    estimated = np.array([recording.estimated[ns] for ns in stamps])
    times = (np.array(stamps) - start_ns) / 1e9
    coverage = np.array(
        [((ns - start_ns) / 1e9, seen.coverage(patch)) for ns, patch in recording.maps]
    )
    ending = ExplorationOutcome(
        bool(result['finished']), str(result['reason']), recording.collisions
    )
    report = exploration_report(ending, times, true, estimated, coverage, _census(recording))
    report['missing_area'] = missing_area_report(recording.missing, recording.hidden)
    # Also the heading: a live run is evaluated by its poses.
    turned = se2.wrap(np.asarray(estimated[:, 2] - true[:, 2]))
    report['heading_rmse_deg'] = round(float(np.degrees(np.sqrt(np.mean(turned**2)))), 4)
    return report


def _census(recording: Recording) -> EndNodeCensus:
    census = EndNodeCensus()
    for ns, nodes in recording.end_nodes:
        if ns in recording.estimated:
            census.add(nodes, recording.estimated[ns])
    return census
