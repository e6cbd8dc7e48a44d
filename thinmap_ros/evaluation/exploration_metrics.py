"""Metrics of an exploration, from plain arrays, for the simulator and for the live graph."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from thinmap_ros.closed_loop.loop import ExplorationOutcome
from thinmap_ros.core.exploration.belief import WORTH_SEEING_M2, MissingArea
from thinmap_ros.core.exploration.paper import NEAR_M
from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID
from thinmap_ros.core.se2 import Array, wrap
from thinmap_ros.evaluation.trajectory_errors import aligned_rms

MILESTONES = (0.90, 0.95, 0.98, 0.99)
SAME_PLACE_M = 1.0
MIN_OBSERVATIONS = 5


@dataclass(eq=False)
class _Place:
    """Place of an end node: latest id and position (m), number of observations, and visits."""

    node_id: int
    x: float
    y: float
    observations: int = 0
    visited: bool = False


class EndNodeCensus:
    """Counts the places of end nodes, and those that the robot visited.

    End nodes move as the map grows, and may reappear with new ids: a new one within SAME_PLACE_M of
    the last position of a vanished one continues it. End nodes that existed for fewer than
    MIN_OBSERVATIONS decisions are not counted, and neither are frontier candidates.
    """

    def __init__(self) -> None:
        self._places: list[_Place] = []
        self._by_id: dict[int, _Place] = {}

    @property
    def seen(self) -> int:
        """Number of places with a persistent end node."""
        return sum(place.observations >= MIN_OBSERVATIONS for place in self._places)

    @property
    def visited(self) -> int:
        """Number of these places that were visited."""
        return sum(
            place.visited and place.observations >= MIN_OBSERVATIONS for place in self._places
        )

    def add(self, end_nodes: Iterable[tuple[int, float, float]], T_map_base: Array) -> None:
        """Add the end nodes (id, x, y in m) of a decision at a pose (3,).

        A visit is a distance below 0.5 m (equation (2)).
        """
        nodes = {node_id: (x, y) for node_id, x, y in end_nodes if node_id < FIRST_FRONTIER_ID}
        idle: list[_Place] | None = None
        at = (float(T_map_base[0]), float(T_map_base[1]))
        for node_id, (x, y) in nodes.items():
            place = self._by_id.get(node_id)
            if place is None:
                if idle is None:
                    idle = [other for other in self._places if other.node_id not in nodes]
                place = self._matching_place(idle, x, y)
                self._by_id.pop(place.node_id, None)
                self._by_id[node_id] = place
                place.node_id = node_id
            place.x = x
            place.y = y
            place.observations += 1
            place.visited |= math.dist((x, y), at) < NEAR_M

    def _matching_place(self, idle: list[_Place], x: float, y: float) -> _Place:
        near = min(idle, key=lambda place: math.dist((x, y), (place.x, place.y)), default=None)
        if near is not None and math.dist((x, y), (near.x, near.y)) <= SAME_PLACE_M:
            idle.remove(near)
            return near
        self._places.append(_Place(0, x, y))
        return self._places[-1]


class TargetLog:
    """Counts target changes, and returns to the target before the last (oscillation)."""

    def __init__(self) -> None:
        self.changes = self.reversals = 0
        self._last: list[tuple[float, float]] = []

    def add(self, goal: Array | None) -> None:
        """Add the goal (x, y, ...), m, of a decision.

        A goal within SAME_PLACE_M of the last one is the same.
        """
        if goal is None:
            return
        at = (float(goal[0]), float(goal[1]))
        if self._last and math.dist(at, self._last[-1]) <= SAME_PLACE_M:
            return
        self.changes += bool(self._last)
        self.reversals += len(self._last) > 1 and math.dist(at, self._last[-2]) <= SAME_PLACE_M
        self._last = [*self._last[-1:], at]


def exploration_report(
    ending: ExplorationOutcome,
    times_s: Array,
    true_poses: Array,
    estimated_poses: Array,
    coverage: Array,
    census: EndNodeCensus,
) -> dict[str, Any]:
    """Report of an exploration, ready for JSON.

    times_s (N,): since the start; true_poses, estimated_poses (N, 3): at these times, in the same
    frame; coverage (M, 2): time in s and coverage, 0 to 1, of each measurement. `distance`, and the
    times and distances of the first measurement of a coverage, refer to the true path, in m and s;
    None if it was not reached. `pose_rmse`, m, includes the heading error of the first scans, which
    turns the whole map; `pose_rmse_aligned` is the error of the map's shape alone. `curve`: time,
    distance and coverage of each measurement; `error_curve`: time and position error.
    """
    steps = np.hypot(*np.diff(true_poses[:, :2], axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    times_at = {f'{share:.2f}': first_time(coverage, share) for share in MILESTONES}
    distances_at = {
        share: None if time is None else round(float(np.interp(time, times_s, along)), 3)
        for share, time in times_at.items()
    }
    errors = np.hypot(*(estimated_poses[:, :2] - true_poses[:, :2]).T)
    return {
        'finished': ending.finished,
        'reason': ending.reason,
        'coverage': round(float(coverage[-1, 1]), 5),
        'distance': round(float(along[-1]), 3),
        'time': round(float(times_s[-1] - times_s[0]), 3),
        'distance_at': distances_at,
        'time_at': times_at,
        'collisions': ending.collisions,
        'end_nodes_seen': census.seen,
        'end_nodes_visited': census.visited,
        'pose_rmse': round(float(np.sqrt(np.mean(errors**2))), 5),
        'pose_rmse_aligned': round(aligned_rms(estimated_poses, true_poses), 5),
        'turned_rad': round(float(np.abs(wrap(np.diff(true_poses[:, 2]))).sum()), 2),
        'curve': [
            [
                round(float(time), 2),
                round(float(np.interp(time, times_s, along)), 2),
                round(float(share), 4),
            ]
            for time, share in coverage
        ],
        'error_curve': [
            [round(float(time), 2), round(float(error), 4)]
            for time, error in zip(
                coverage[:, 0], np.interp(coverage[:, 0], times_s, errors), strict=True
            )
        ],
    }


def first_time(coverage: Array, share: float) -> float | None:
    """Time, s, of the first measurement (time, coverage) (M, 2) of a coverage; None: of none."""
    reached = np.flatnonzero(coverage[:, 1] >= share)
    return round(float(coverage[reached[0], 0]), 3) if reached.size else None


def exploration_title(report: dict[str, Any]) -> str:
    """Title of a report: world, area seen, distance and time."""
    return (
        f'{report["world"]}: {100.0 * report["coverage"]:.1f} % seen, '
        f'{report["distance"]:.1f} m, {report["time"]:.0f} s'
    )


def missing_area_report(
    missing: MissingArea | None, hidden: Iterable[tuple[float, float, float]]
) -> dict[str, Any] | None:
    """What an exploration has probably not seen, m2, and where; None where nothing is estimated.

    hidden: position, m, and expected hidden area of each end node and frontier.
    """
    if missing is None:
        return None
    places = sorted(hidden, key=lambda place: -place[2])
    return {
        'expected_m2': round(missing.expected_m2, 1),
        'bound_95_m2': round(missing.bound_m2, 1),
        'places': [
            {'x': round(x, 2), 'y': round(y, 2), 'expected_m2': round(area, 1)}
            for x, y, area in places
            if area >= WORTH_SEEING_M2
        ],
    }


def hidden_places(report: dict[str, Any]) -> Array:
    """Places of a report's `missing_area`, (N, 3): x, y, m, and expected area, m2."""
    missing = report['missing_area'] or {'places': []}
    rows = [(place['x'], place['y'], place['expected_m2']) for place in missing['places']]
    return np.array(rows).reshape(-1, 3)
