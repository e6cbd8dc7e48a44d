"""Results of a run of the live graph, from its bag."""

import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.closed_loop.loop import ExplorationOutcome
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.belief import MissingArea
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap, topology_from_msg
from thinmap_ros.evaluation.exploration_metrics import (
    MILESTONES,
    EndNodeCensus,
    exploration_report,
    exploration_title,
    first_time,
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
    """The run of a robot: paths by stamp, maps by stamp, the last graph, end nodes, contacts.

    name: '' of a single robot; T_world_map (3,): pose of the frame of its map in the world; result:
    of its exploration, as of demo_monitor. hidden: position, m, and expected hidden area, m2, of
    each end node at the end; missing: area.
    """

    name: str
    T_world_map: Array
    result: dict[str, Any]
    true: dict[int, Array] = field(default_factory=dict)
    estimated: dict[int, Array] = field(default_factory=dict)
    maps: list[tuple[int, GridPatch]] = field(default_factory=list)
    topology: TopologicalMap = field(default_factory=TopologicalMap)
    end_nodes: list[tuple[int, list[tuple[int, float, float]]]] = field(default_factory=list)
    hidden: list[tuple[float, float, float]] = field(default_factory=list)
    missing: MissingArea | None = None
    collisions: int = 0
    range_max_m: float = 8.0

    @property
    def start_ns(self) -> int:
        """Stamp of the beginning of the exploration."""
        return int(self.result['start_ns'])

    @property
    def end_ns(self) -> int:
        """Stamp of its end."""
        return int(self.result['end_ns'])

    @property
    def driven(self) -> Array:
        """The true path (N, 3), world frame, of the exploration."""
        within = [self.true[ns] for ns in self.true if self.start_ns <= ns <= self.end_ns]
        return np.array(within).reshape(-1, 3)

    @property
    def distance_m(self) -> float:
        """Length of this path."""
        return se2.path_length_m(self.driven)


def read(path: Path, T_world_map: Array, result: dict[str, Any]) -> Recording:
    """Read the outputs from the bag of a run; arguments as of Recording.

    Raises InputError if a topic is missing.
    """
    bag = Bag(path)
    name = str(result.get('name', ''))
    prefix = f'/{name}/' if name else '/'
    recording = Recording(name, T_world_map, result)
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
            recording.topology = _topology(path, raw.topic, message)
        elif topic == 'end_nodes':
            nodes = decode.end_nodes(message)
            recording.end_nodes.append((ns, [node[:3] for node in nodes]))
            recording.hidden = [(node.x, node.y, node.area_m2) for node in nodes]
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


def _topology(path: Path, topic: str, message: Any) -> TopologicalMap:
    """Topological map of a message. Raises InputError, with path and topic, if it is invalid."""
    try:
        return topology_from_msg(message)
    except InputError as error:
        raise InputError(f'{path}: {topic}: {error}') from error


def _missing_area(message: Any) -> MissingArea | None:
    areas = (float(message.missing_area_m2), float(message.missing_area_bound_m2))
    return MissingArea(*areas) if min(areas) >= 0.0 else None


def _report(recording: Recording, seen: ObservableCells) -> dict[str, Any]:
    start_ns = recording.start_ns
    result = recording.result
    within = [ns for ns in recording.true if start_ns <= ns <= recording.end_ns]
    stamps = [ns for ns in within if ns in recording.estimated]
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


_TEAM_TOPICS = {'/merged_map', '/merged_topology', '/join_status'}


@dataclass(eq=False)
class _Joint:
    """What map_joiner has published: the last map and graph, and the places of the maps.

    joined_ns: since when the map of each robot has been joined; places: its pose (3,) now.
    """

    patch: GridPatch | None = None
    topology: TopologicalMap = field(default_factory=TopologicalMap)
    joined_ns: dict[str, int] = field(default_factory=dict)
    places: dict[str, Array] = field(default_factory=dict)

    def add_status(self, ns: int, message: Any) -> None:
        """Add a JoinStatus of a time."""
        joined = {each.name.strip('/'): each for each in message.maps if each.is_joined}
        self.joined_ns = {name: self.joined_ns.get(name, ns) for name in joined}
        self.places = {name: decode.pose(each.pose) for name, each in joined.items()}


def write(
    out: Path,
    world_file: Path,
    robot: str,
    result: dict[str, Any],
    map_poses: Sequence[Array],
    command: str = '',
) -> dict[str, Any]:
    """Write map, graph, trajectories, picture and report of a run in out/bag.

    Of several robots the map is the joint one, or that of the first robot where none is joined; of
    a single one there is, with rerun, a recording.
    robot: preset of all; result: of demo_monitor; map_poses: pose (3,) in the world of the frame of
    each map. Returns the report.
    """
    bag = out / 'bag'
    results = result.get('robots', [result])
    robots = [read(bag, pose, each) for pose, each in zip(map_poses, results, strict=True)]
    joint = _read_joint(bag)
    world = World.from_patch(*read_world(world_file))
    first = robots[0]
    start = next(iter(first.true.values()))
    range_m = max(each.range_max_m for each in robots)
    seen = robot_observable_cells(world, start, PRESETS[robot], range_m)
    is_team = len(robots) > 1
    report = _team_report(robots, joint, seen) if is_team else _report(first, seen)
    report['world'] = world.name
    title = exploration_title(report)
    trajectories = {
        f'trajectory_{each.name}' if is_team else 'trajectory': (
            list(each.estimated),
            list(each.estimated.values()),
        )
        for each in robots
    }
    run = RunResult(
        first.maps[-1][1] if joint.patch is None else joint.patch,
        first.topology if joint.patch is None else joint.topology,
        title,
        trajectories,
        np.empty((0, 3)) if is_team else np.array(list(first.estimated.values())),
        _shown(robots, joint, report),
    )
    write_run(out, run)
    if not is_team and rerun_sinks.is_installed():
        recording_from_bag(bag, out / 'recording.rrd')
    elif not is_team:
        print(f'no recording.rrd: {rerun_sinks.ADVICE}', file=sys.stderr)
    write_report(out, title, report, command)
    return report


def _shown(robots: Sequence[Recording], joint: _Joint, report: dict[str, Any]) -> dict[str, Any]:
    """What the picture shows beside the map: the paths that were driven."""
    if len(robots) == 1:
        true = np.array(list(robots[0].true.values()))
        return {'true': true, 'hidden': hidden_places(report)}
    T_merged_world = _world_pose(robots, joint)
    paths = [se2.transform_points(T_merged_world, each.driven[:, :2]) for each in robots]
    return {'robots': {each.name: path for each, path in zip(robots, paths, strict=True)}}


def _read_joint(path: Path) -> _Joint:
    bag = Bag(path)
    joint = _Joint()
    for raw in bag.messages(_TEAM_TOPICS):
        message = bag.decode(raw)
        if raw.topic == '/merged_map':
            joint.patch = decode.patch(message)
        elif raw.topic == '/merged_topology':
            joint.topology = _topology(path, raw.topic, message)
        else:
            joint.add_status(decode.stamp_ns(message), message)
    if not joint.places:
        joint.patch = None
    return joint


def _world_pose(robots: Sequence[Recording], joint: _Joint) -> Array:
    """Pose (3,) of the world in the frame of the map that is written.

    By the map that lies in it without a search: its own frame, or the first one there.
    """
    reference = next((each for each in robots if each.name in joint.places), robots[0])
    place = joint.places.get(reference.name, np.zeros(3))
    return se2.compose(place, se2.invert(reference.T_world_map))


def _team_report(
    robots: Sequence[Recording], joint: _Joint, seen: ObservableCells
) -> dict[str, Any]:
    start_ns = min(each.start_ns for each in robots)
    end_ns = max(each.end_ns for each in robots)
    curve = _coverage(robots, seen, start_ns)
    T_merged_world = _world_pose(robots, joint)
    reports = [_robot_report(each, joint, T_merged_world, start_ns) for each in robots]
    reasons = dict.fromkeys(str(each.result['reason']) for each in robots)
    return {
        'finished': all(each.result['finished'] for each in robots),
        'reason': '; '.join(reasons),
        'coverage': round(float(curve[-1, 1]), 5),
        'distance': round(sum(each.distance_m for each in robots), 3),
        'time': round((end_ns - start_ns) / 1e9, 3),
        'time_at': {f'{share:.2f}': first_time(curve, share) for share in MILESTONES},
        'collisions': sum(each.collisions for each in robots),
        'robots': reports,
        'joins': [_join_text(each) for each in reports],
        'curve': [[round(float(at), 2), round(float(share), 4)] for at, share in curve],
    }


def _robot_report(
    robot: Recording, joint: _Joint, T_merged_world: Array, start_ns: int
) -> dict[str, Any]:
    """Figures of a robot; joined_at: of its map, s; join_error: m and deg against the truth."""
    shared = [ns for ns in robot.true if ns in robot.estimated]
    estimated = np.array([se2.compose(robot.T_world_map, robot.estimated[ns]) for ns in shared])
    errors = np.hypot(*(estimated - [robot.true[ns] for ns in shared])[:, :2].T)
    joined_ns = joint.joined_ns.get(robot.name)
    error = None
    if joined_ns is not None:
        expected = se2.compose(T_merged_world, robot.T_world_map)
        x, y, turn = se2.between(expected, joint.places[robot.name]).tolist()
        error = [round(float(np.hypot(x, y)), 4), round(abs(float(np.degrees(turn))), 3)]
    return {
        'name': robot.name,
        'finished': robot.result['finished'],
        'reason': robot.result['reason'],
        'distance': round(robot.distance_m, 3),
        'time': round((robot.end_ns - robot.start_ns) / 1e9, 3),
        'collisions': robot.collisions,
        'pose_rmse': round(float(np.sqrt(np.mean(errors**2))), 5),
        'joined_at': None if joined_ns is None else round((joined_ns - start_ns) / 1e9, 3),
        'join_error': error,
    }


def _join_text(robot: dict[str, Any]) -> str:
    """When the map of a robot was joined, and with which error, in words."""
    if robot['join_error'] is None:
        return f'{robot["name"]}: not joined'
    off_m, off_deg = robot['join_error']
    after = f'{robot["name"]}: after {robot["joined_at"]:.0f} s'
    return f'{after}, off by {off_m:.2f} m, {off_deg:.1f} deg'


def _coverage(robots: Sequence[Recording], seen: ObservableCells, start_ns: int) -> Array:
    """Time, s, and share of the area that one of the maps holds, for each map (N, 2)."""
    maps = [(ns, patch, each) for each in robots for ns, patch in each.maps]
    known = {}
    curve = []
    for ns, patch, each in sorted(maps, key=lambda entry: entry[0]):
        known[each.name] = seen.known(patch, each.T_world_map)
        curve.append(((ns - start_ns) / 1e9, seen.share(list(known.values()))))
    return np.array(curve)
