"""Joint maps: what robots send, when they are joined and how well, at which cost."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import numpy as np

from benchmarks.places.pieces import explored, overlap_errors
from benchmarks.worlds import Floor
from thinmap_ros.closed_loop import ClosedLoop
from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import Keyframe, KeyframeConfig
from thinmap_ros.core.slam.joining.messages import KeyframeMessage, KeyframeSender, SentEdge
from thinmap_ros.core.slam.joining.pieces import ReceivedKeyframes, RobotKeyframes
from thinmap_ros.core.slam.joining.team import WORLD, Team, TeamGraph
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.stage import Estimate
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.evaluation.outcome import Table
from thinmap_ros.nodes.parts.joining import JointMap
from thinmap_ros.sim.drives import random_drive

_EACH_M = 10.0
_POSE_BYTES = 12  # three numbers of 32 bit
_STEP = np.diag([1.0 / 0.02**2, 1.0 / 0.02**2, 1.0 / 0.005**2])


@dataclass(frozen=True, eq=False)
class SentMap:
    """What others know of a robot's map after a path (m).

    truth (N, 3): true poses of its keyframes; keyframe_bytes: sent so far.
    """

    path_m: float
    patch: GridPatch
    graph: TopologicalMap
    keyframes: RobotKeyframes
    truth: Array
    keyframe_bytes: int


class _Radio:
    """Sends the keyframes of an exploration as bytes, and keeps what came each 10 m."""

    is_lost = False

    def __init__(self) -> None:
        self.sent: list[SentMap] = []
        self._sender: KeyframeSender | None = None
        self._received = ReceivedKeyframes()
        self._truth: dict[int, Array] = {}  # by the stamp of the scan
        self._told: list[Array] = []
        self._bytes = 0
        self._path_m = 0.0

    def intercepts(self, loop: ClosedLoop, scan: Scan, T_odom_base: Array) -> bool:
        """No scan."""
        return False

    def add_estimate(self, loop: ClosedLoop, scan: Scan, estimate: Estimate) -> None:
        """Send what is new."""
        poses = loop.log.true_poses
        self._truth[scan.stamp_ns] = poses[-1]
        if len(poses) > 1:
            self._path_m += float(np.hypot(*(poses[-1] - poses[-2])[:2]))
        localizer = loop.pipeline.localizer
        assert isinstance(localizer, Localizer) and localizer.published_graph is not None
        self._sender = self._sender or KeyframeSender(localizer.published_graph)
        self._send(self._sender)
        known = self._received.known()
        if known is not None and self._path_m >= _EACH_M * (len(self.sent) + 1):
            pipeline = loop.pipeline
            patch = pipeline.grid.known_area()
            truth = np.array(self._told[: len(known.frames)])
            self.sent.append(
                SentMap(self._path_m, patch, pipeline.topology.map, known, truth, self._bytes)
            )

    def _send(self, sender: KeyframeSender) -> None:
        poses = sender.corrected_poses()
        if poses is not None:
            self._bytes += _POSE_BYTES * len(poses)
            self._received.correct(1, sender.revision, poses)
        message = sender.next_message()
        if message is not None:
            data = message.encode()
            self._bytes += len(data)
            self._received.add(1, 1, KeyframeMessage.decode(data))
            if message.number == len(self._told):
                self._told.append(self._truth[message.scan.stamp_ns])


def explorations(floor: Floor, start: int, limit_s: float) -> list[SentMap]:
    """What a robot with SLAM has sent each 10 m of an exploration, for so many seconds."""
    radio = _Radio()
    explored(floor.world, floor.starts[start], start, limit_s, radio)
    return radio.sent


def random_drives(floor: Floor, start: int, seconds: float, each_m: float) -> Iterator[SentMap]:
    """What a robot with true poses has sent each so many m of a drive to random places."""
    T_start = floor.starts[start]
    grid = OccupancyGrid()
    frames: list[Keyframe] = []
    path_m = 0.0
    next_m = each_m
    last = T_start
    for sample in random_drive(floor.world, T_start, start):
        path_m += float(np.hypot(*(sample.T_world_base - last)[:2]))
        last = sample.T_world_base
        own = se2.between(T_start, last)
        grid.add_scan(sample.scan, own)
        if not frames or path_m - frames[-1].path_m >= KeyframeConfig.distance_m:
            points = surface_points(sample.scan)
            frames.append(Keyframe(sample.scan, points, own, path_m, np.zeros((3, 3)), submap=0))
        is_over = sample.scan.stamp_ns >= seconds * 1e9
        if path_m >= next_m or is_over:
            next_m += each_m
            edges = [SentEdge(k, k + 1, _STEP) for k in range(len(frames) - 1)]
            patch = grid.known_area()
            graph = build(patch, None, TopologyConfig())
            keyframes = RobotKeyframes(1, list(frames), edges)
            yield SentMap(path_m, patch, graph, keyframes, keyframes.poses, 0)
        if is_over:
            return


_RIGHT_M = 0.5  # where the maps overlap
_ROBOTS = 5
_DRIVE_EACH_M = 100.0
_FOREIGN_EACH_M = 40.0
_BEAT_S = 0.005
_IDLE_S = 10.0


def two_robots(floors: Sequence[Floor], seconds: float) -> Table:
    """Two robots with SLAM in each world, which search each 10 m; error where they overlap."""
    columns = (
        'world',
        'joined at m each',
        'right',
        'at m',
        'keyframes that overlap',
        'matches',
        'RMS error m: rigid',
        'RMS error m: after the graph',
        'largest error m: rigid',
        'largest error m: after the graph',
        'keyframes: bytes a m',
    )
    return Table('two_robots', columns, [_joined(floor, seconds) for floor in floors], timed=False)


def _joined(floor: Floor, seconds: float) -> list[Any]:
    first, second = (explorations(floor, start, seconds) for start in (0, 1))
    team = Team()
    graph = TeamGraph()
    joined_m: float | None = None
    is_right = True
    errors: list[Array] = []
    if not (first and second):
        return [floor.name, *[None] * 10]  # one of them has not come 10 m far
    sent_bytes = [sent[-1].keyframe_bytes / sent[-1].path_m for sent in (first, second)]
    for a, b in zip(first, second, strict=False):
        for name, sent in (('/a', a), ('/b', b)):
            team.receive(name, sent.patch, sent.graph, sent.keyframes)
        _search_all(team)
        places = team.places()
        if not places:
            continue
        joined_m = joined_m or a.path_m
        keyframes = {'/a': a.keyframes, '/b': b.keyframes}
        rigid = {name: _moved(T, keyframes[name].poses) for name, T in places.items()}
        bend = graph.bend(keyframes, places)
        errors = [
            overlap_errors(a.truth, b.truth, poses['/a'], poses['/b'])
            for poses in (rigid, bend.poses or rigid)
        ]
        is_right = is_right and bool(errors[1].max(initial=0.0) < _RIGHT_M)
    row: list[Any] = [floor.name, joined_m, is_right if joined_m else None]
    row += [min(first[-1].path_m, second[-1].path_m)]
    if errors and len(errors[0]):
        row += [len(errors[0]), graph.count_links()]
        row += [float(np.sqrt(np.mean(each**2))) for each in errors]
        row += [float(each.max()) for each in errors]
    else:
        row += [None] * 6
    return [*row, float(np.mean(sent_bytes))]


def load(floors: Sequence[Floor], seconds: float) -> Table:
    """Five robots in the first world, with true poses: processor time of each kind of job.

    The node waits while a job holds the interpreter: the longest time is that of a thread that
    wakes up each 5 ms; without a job it waits for the other programs of the machine only.
    """
    (floor,) = floors[:1]
    drives = [random_drives(floor, start, seconds, _DRIVE_EACH_M) for start in range(_ROBOTS)]
    team = Team()
    joint = JointMap()
    taken: dict[str, list[tuple[float, float]]] = {'nothing': [], 'search': [], 'merge': []}
    with _timed(taken['nothing']):
        time.sleep(_IDLE_S)
    areas: list[float] = []
    for sent_by_all in zip_longest(*drives):
        for number, sent in enumerate(sent_by_all):
            if sent is None:
                continue
            name = f'/robot{number + 1}'
            if name not in team.maps:
                team.give(WORLD, name, floor.starts[number])
            team.receive(name, sent.patch, sent.graph, sent.keyframes)
        while (search := team.next_search()) is not None:
            with _timed(taken['search']):
                result = search.run()
            team.found(search, *result)
        with _timed(taken['merge']):
            merge = joint.merge(dict(team.maps), team.places())
        joint.take(merge)
        areas = [robot.piece.places.free_area_m2 for robot in team.maps.values()]
        print(f'{min(areas):.0f} to {max(areas):.0f} m2, {len(merge.bend.poses)} bend', flush=True)
    columns = (
        'job',
        'jobs',
        'median CPU s',
        'last CPU s',
        'longest CPU s',
        'node waits at most ms',
    )
    rows = [
        [
            f'{kind}, {_ROBOTS} robots, {min(areas):.0f} to {max(areas):.0f} m2 each',
            len(found),
            float(np.median([cpu for cpu, _ in found])),
            found[-1][0],
            max(cpu for cpu, _ in found),
            1e3 * max(wait for _, wait in found),
        ]
        for kind, found in taken.items()
    ]
    return Table('load', columns, rows, timed=True)


def foreign(floors: Sequence[Floor], seconds: float) -> Table:
    """A robot in each world, with true poses: no two of them are to be joined."""
    drives = [random_drives(floor, 0, seconds, _FOREIGN_EACH_M) for floor in floors]
    team = Team()
    joins: list[str] = []
    searches = 0
    highest = -np.inf
    for sent_by_all in zip_longest(*drives):
        for floor, sent in zip(floors, sent_by_all, strict=True):
            if sent is not None:
                team.receive(f'/{floor.name}', sent.patch, sent.graph, sent.keyframes)
        for pair, is_joined, log_odds in _search_all(team):
            searches += 1
            highest = max(highest, log_odds)
            if is_joined:
                joins.append(' and '.join(pair))
        print(f'{searches} searches, {len(joins)} joins', flush=True)
    pairs = len(floors) * (len(floors) - 1) // 2
    columns = ('pairs of buildings', 'hours of all pairs', 'searches', 'joins', 'highest log odds')
    hours = pairs * seconds / 3600.0
    row = [pairs, hours, searches, len(joins), float(highest)]
    return Table('foreign', columns, [row, *[[name, *[None] * 4] for name in joins]])


def _search_all(team: Team) -> Iterator[tuple[tuple[str, str], bool, float]]:
    """Run all searches; returns pair, whether it is joined, and log odds of each."""
    found = []
    while (search := team.next_search()) is not None:
        link, log_odds = search.run()
        team.found(search, link, log_odds)
        found.append(((search.a, search.b), link is not None, log_odds))
    return iter(found)


def _moved(T: Array, poses: Array) -> Array:
    return np.array([se2.compose(T, own) for own in poses])


@contextmanager
def _timed(taken: list[tuple[float, float]]) -> Iterator[None]:
    """Add the processor time of a block, and how late a second thread woke up meanwhile, s."""
    late = [0.0]
    is_done = threading.Event()
    thread = threading.Thread(target=_beat, args=(late, is_done.is_set))
    thread.start()
    began_s = time.thread_time()
    yield
    cpu_s = time.thread_time() - began_s
    is_done.set()
    thread.join()
    taken.append((cpu_s, late[0]))


def _beat(late: list[float], is_done: Callable[[], bool]) -> None:
    while not is_done():
        before = time.monotonic()
        time.sleep(_BEAT_S)
        late[0] = max(late[0], time.monotonic() - before - _BEAT_S)
