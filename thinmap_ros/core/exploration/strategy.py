"""Exploration strategy: chooses where the robot drives next, from graph, map and scan."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.errors import counted
from thinmap_ros.core.exploration.belief import MissingArea
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.topology.graph import TopologicalMap

# Ids from here on are those of frontier candidates that no end node sees.
FIRST_FRONTIER_ID = 2_000_000_000

_NEAR_M = 0.3
_NEAR_RAD = 0.35
_MIN_SCANS = 3
_START_S = 5.0


class FinishCode(IntEnum):
    """Why an exploration ended, as in thinmap_msgs/ExplorationStatus.

    A strategy ends it with ALL_RESOLVED or UNREACHABLE, a mission with any of the others.
    """

    NONE = 0
    ALL_RESOLVED = 1
    BUDGET_EXHAUSTED = 2
    CANCELLED = 3
    UNREACHABLE = 4
    LOCALIZATION_LOST = 5
    SENSOR_TIMEOUT = 6


class EndNode(NamedTuple):
    """An end node at x, y in m (map frame), with its position probability and what it comes from.

    node_id: id in the topological map, or from FIRST_FRONTIER_ID on, below 2^32; goal: pose (3,)
    from which to observe it; distance_index, angle_index, min_distance_m, angle_span_deg: of the
    strategy `paper`, which counts observations; frontier_length_m: length of a frontier;
    expected_area_m2: hidden area expected behind that.
    """

    node_id: int
    x: float
    y: float
    probability: float
    distance_index: float
    angle_index: float
    min_distance_m: float
    angle_span_deg: float
    frontier_length_m: float
    expected_area_m2: float
    is_target: bool
    goal: Array


def unobserved(
    node_id: int,
    place: tuple[float, float],
    probability: float,
    goal: Array | None = None,
    is_target: bool = False,
    frontier_length_m: float = 0.0,
    expected_area_m2: float = 0.0,
) -> EndNode:
    """End node at a place (x, y), m, without counted observations; see EndNode."""
    return EndNode(
        node_id,
        *place,
        probability,
        0.0,
        0.0,
        math.inf,
        0.0,
        frontier_length_m,
        expected_area_m2,
        is_target,
        np.array([*place, 0.0]) if goal is None else goal,
    )


@dataclass(frozen=True)
class Decision:
    """What to do next: drive to target.goal, stay, or finish.

    reason: words for the end, or for the progress; unreachable: ids of end nodes that are put aside
    or given up: without a way to them, or visited in vain; remaining: how many are not resolved,
    these included; missing: free area that is not seen; None where the strategy does not estimate
    it.
    """

    target: EndNode | None
    finished: bool
    reason: str
    code: FinishCode
    end_nodes: list[EndNode]
    unreachable: list[int]
    known_area_m2: float
    remaining: int = 0
    missing: MissingArea | None = None

    @property
    def coverage_estimate(self) -> float:
        """Known free area over that and the missing one, 0 to 1; 0 where nothing is estimated."""
        if self.missing is None or self.known_area_m2 <= 0.0:
            return 0.0
        return self.known_area_m2 / (self.known_area_m2 + self.missing.expected_m2)


@runtime_checkable
class Strategy(Protocol):
    """An exploration strategy: the project's own, or any that is compared with it."""

    def step(
        self, topology: TopologicalMap, patch: GridPatch, scan: Scan, T_map_base: Array
    ) -> Decision:
        """Choose where to drive, from the graph, the whole map and a scan made at a pose (3,)."""

    def target_failed(self, reason: str) -> None:
        """Process that the present target could not be reached."""


@runtime_checkable
class ShowsFrontiers(Protocol):
    """A strategy that knows the cells of the frontiers it chooses from."""

    def frontiers(self) -> list[Array]:
        """Cells of each frontier, (N, 2), m, map frame."""


@runtime_checkable
class CountsSeconds(Protocol):
    """A strategy that decides by the time to its targets."""

    def path_grew(self, remaining_m: float) -> None:
        """Process that the path to the present target has become longer, to remaining_m."""


@dataclass
class Streak:
    """How many scans in a row something was so: what one scan shows may be noise."""

    scans: int = 0

    def add(self, is_so: bool) -> bool:
        """Add a scan; returns whether it was so often enough."""
        self.scans = self.scans + 1 if is_so else 0
        return self.is_over

    @property
    def is_over(self) -> bool:
        """Whether it was so often enough."""
        return self.scans >= _MIN_SCANS


@dataclass
class Start:
    """The first seconds of an exploration, in which there need not be a graph yet."""

    began_ns: float = math.inf

    def lasts(self, topology: TopologicalMap, stamp_ns: int) -> bool:
        """Whether nothing can be said at a stamp, with a graph."""
        self.began_ns = min(self.began_ns, stamp_ns)
        return not topology.nodes and stamp_ns - self.began_ns < _START_S * SECOND_NS


def is_near(T_map_base: Array, place: Sequence[float] | Array) -> bool:
    """Whether a robot at a pose (3,) is at a place (x, y, ...), m."""
    return math.dist(T_map_base[:2], place[:2]) <= _NEAR_M


def is_at(T_map_base: Array, goal: Array) -> bool:
    """Whether a robot at a pose (3,) is at a goal (3,), and looks where it should."""
    is_turned = abs(se2.wrap(float(goal[2] - T_map_base[2]))) <= _NEAR_RAD
    return is_turned and is_near(T_map_base, goal)


def decide(
    end_nodes: list[EndNode],
    is_finished: bool,
    left: int,
    aside: Iterable[int] = (),
    known_area_m2: float = 0.0,
    missing: MissingArea | None = None,
) -> Decision:
    """Decision for the end node that is the target; see there.

    left: how many are not resolved; when the exploration is finished, each of these is given up.
    """
    target = next((node for node in end_nodes if node.is_target), None)
    code = FinishCode.NONE
    words = f'{counted(left, "end node")} left'
    if is_finished:
        code = FinishCode.UNREACHABLE if left else FinishCode.ALL_RESOLVED
        gone = f'{words}, which the robot cannot reach or see into'
        words = gone if left else 'all end nodes resolved'
    return Decision(
        target, is_finished, words, code, end_nodes, sorted(aside), known_area_m2, left, missing
    )


class Observation(NamedTuple):
    """A scan made at a pose (3,) in the map frame, with the graph and the whole map of then."""

    topology: TopologicalMap
    patch: GridPatch
    scan: Scan
    T_map_base: Array
