"""What decides where to go, and what it answers to a scan."""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Protocol

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap

# Ids from here on are those of what stands in for borders that no end node sees.
FIRST_STAND_IN_ID = 2_000_000_000


class FinishCode(IntEnum):
    """Why an exploration ended, as in thinmap_msgs/ExplorationStatus."""

    NONE = 0
    ALL_RESOLVED = 1
    NOTHING_REACHABLE = 4


class EndNode(NamedTuple):
    """An end node as it stands: place x, y in m (map frame), probability and what it comes from.

    goal: pose (3,) from which to look at it; open_border_m: length of the border to the unknown
    that belongs to it.
    """

    node_id: int
    x: float
    y: float
    probability: float
    distance_index: float
    angle_index: float
    smallest_distance_m: float
    angle_span_deg: float
    open_border_m: float
    is_target: bool
    goal: Array


@dataclass(frozen=True)
class Decision:
    """What to do now: drive to target.goal, or nothing more.

    reason: words for the end, or for what is going on; unreachable: ids put aside because they
    could not be reached; coverage_estimate: known free area over that and the area expected behind
    open borders, 0 to 1.
    """

    target: EndNode | None
    finished: bool
    reason: str
    code: FinishCode
    end_nodes: list[EndNode]
    unreachable: list[int]
    coverage_estimate: float
    known_area_m2: float


class Strategy(Protocol):
    """What decides where to go: ours, and everything that it is compared with."""

    def step(
        self, topology: TopologicalMap, patch: GridPatch, scan: Scan, T_map_base: Array
    ) -> Decision:
        """Say where to go, from the graph, the whole map and a scan made at a pose (3,)."""

    def target_failed(self, reason: str) -> None:
        """Hear that the present target could not be reached."""


def verdict(finished: bool, unreachable: list[int], left: int) -> tuple[FinishCode, str]:
    """Code and words for the state of an exploration with so many end nodes left."""
    if not finished:
        return FinishCode.NONE, f'{left} end nodes left'
    if not unreachable:
        return FinishCode.ALL_RESOLVED, 'all end nodes resolved'
    return (
        FinishCode.NOTHING_REACHABLE,
        f'{len(unreachable)} end nodes left, none of them reachable',
    )
