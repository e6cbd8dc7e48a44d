"""Exploration strategy: chooses where the robot drives next, from graph, map and scan."""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from thinmap_ros.core.exploration.belief.model import MissingArea, missing_area
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap

# Ids from here on are those of frontier candidates that no end node sees.
FIRST_FRONTIER_ID = 2_000_000_000


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


def unobserved(node_id: int, place: tuple[float, float], probability: float) -> EndNode:
    """End node at a place (x, y), m, without counted observations: no target, no frontier."""
    goal = np.array([*place, 0.0])
    return EndNode(node_id, *place, probability, 0.0, 0.0, math.inf, 0.0, 0.0, 0.0, False, goal)


@dataclass(frozen=True)
class Decision:
    """What to do next: drive to target.goal, stay, or finish.

    reason: words for the end, or for the progress; unreachable: ids of end nodes that are put aside
    or given up: without a way to them, or visited in vain; remaining: how many are not resolved,
    these included; hidden: of each candidate the probability that it hides nothing, and the mean
    area, m2, that it hides if not; None where the strategy does not estimate them.
    """

    target: EndNode | None
    finished: bool
    reason: str
    code: FinishCode
    end_nodes: list[EndNode]
    unreachable: list[int]
    known_area_m2: float
    remaining: int = 0
    hidden: list[tuple[float, float]] | None = None

    @property
    def missing(self) -> MissingArea | None:
        """Area that is not seen; None where the strategy does not estimate it."""
        return None if self.hidden is None else missing_area(self.hidden)

    @property
    def coverage_estimate(self) -> float:
        """Known free area over that and the missing one, 0 to 1; 0 where nothing is estimated."""
        missing = self.missing
        if missing is None or self.known_area_m2 <= 0.0:
            return 0.0
        return self.known_area_m2 / (self.known_area_m2 + missing.expected_m2)


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


def finish_reason(finished: bool, left: int) -> tuple[FinishCode, str]:
    """Code and words for the state of an exploration with a number of unresolved end nodes.

    When it is finished, each of these is given up.
    """
    words = f'{left} end node{"" if left == 1 else "s"} left'
    if not finished:
        return FinishCode.NONE, words
    if left:
        return FinishCode.UNREACHABLE, f'{words}, which the robot cannot reach or see into'
    return FinishCode.ALL_RESOLVED, 'all end nodes resolved'
