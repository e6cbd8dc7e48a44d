"""Tables of joint maps: when two robots are joined and how well, what it costs, and false joins."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import zip_longest
from typing import Any

import numpy as np

from benchmarks.joining.drives import explorations, random_drives
from benchmarks.places.truth import overlap_errors
from benchmarks.worlds import Floor
from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.joining.team import WORLD, Team, TeamGraph
from thinmap_ros.evaluation.outcome import Table
from thinmap_ros.nodes.parts.joining import JointMap

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
