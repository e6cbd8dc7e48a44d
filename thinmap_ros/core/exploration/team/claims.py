"""Claims: what each robot of a team sends the others, and how long it holds.

A claim names the place of a frontier and no id of a node, so that each robot can have a graph of
its own. It holds as long as its robot is received and comes nearer to the place.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.se2 import SECOND_NS, Array

Place = tuple[float, float]
SAME_PLACE_M = 0.5  # a claimed place that moves less is the same one
_PROGRESS_M = 0.5


@dataclass(frozen=True)
class SilenceConfig(Config):
    """How long a robot that is silent counts."""

    claim_timeout_s: float = parameter(
        15.0,
        'Silence after which another robot claims nothing, and is an obstacle as any other (s). '
        'Raise it on a bad network. Set it for explorer, grid_mapper and navigator.',
        low=1.0,
        high=1000.0,
    )


@dataclass(frozen=True)
class ClaimConfig(SilenceConfig):
    """How long a claim holds."""

    progress_timeout_s: float = parameter(
        20.0,
        'Time without progress after which the claim of another robot ends (s). Raise it where '
        'robots wait for doors.',
        low=1.0,
        high=1000.0,
    )


class SettledPlace(NamedTuple):
    """A place (x, y), m, that a robot has visited or found no path to, each so many times."""

    x: float
    y: float
    visits: int
    failures: int


@dataclass(frozen=True, eq=False)
class Claim:
    """What a robot sends the others, about once a second and when its target changes.

    robot: its name; stamp_ns: by its own clock; pose (3,); place: of the frontier that it drives
    to, m, None without a target; remaining_m: rest of its path, 0 before it is planned; settled:
    its latest places; explores: False for one that takes no candidate, whatever is left.
    """

    robot: str
    stamp_ns: int
    pose: Array
    place: Place | None = None
    remaining_m: float = 0.0
    settled: tuple[SettledPlace, ...] = ()
    explores: bool = True

    @property
    def path_m(self) -> float:
        """Rest of the path to the claimed place; the straight line before a path is planned."""
        if self.place is None or self.remaining_m > 0.0:
            return self.remaining_m
        return math.dist(self.pose[:2], self.place)


@dataclass
class _Received:
    """A claim, when it came and when its robot made progress, by this robot's clock, ns.

    nearest_m: smallest remaining path to the claimed place.
    """

    claim: Claim
    received_ns: int
    progress_ns: int
    nearest_m: float


class Claims:
    """The newest claim of each other robot."""

    def __init__(self, config: ClaimConfig | None = None) -> None:
        self.config = config or ClaimConfig()
        self._received: dict[str, _Received] = {}

    def add(self, claim: Claim, now_ns: int) -> None:
        """Add a claim received now; one older than the last of the same robot is ignored.

        After a silence any stamp is accepted: the robot may have restarted with another clock.
        """
        last = self._received.get(claim.robot)
        if last is None or not self._is_recent(last, now_ns):
            self._received[claim.robot] = _Received(claim, now_ns, now_ns, _planned_m(claim))
            return
        if claim.stamp_ns <= last.claim.stamp_ns:
            return
        is_nearer = _planned_m(claim) < last.nearest_m - _PROGRESS_M
        if is_nearer or not is_same_place(claim.place, last.claim.place):
            last.progress_ns = now_ns
            last.nearest_m = _planned_m(claim)
        last.claim = claim
        last.received_ns = now_ns

    def present(self, now_ns: int) -> list[Claim]:
        """Claims of the robots that were received recently, in the order of their names."""
        received = [r for r in self._received.values() if self._is_recent(r, now_ns)]
        return sorted((r.claim for r in received), key=lambda claim: claim.robot)

    def held(self, now_ns: int) -> list[Claim]:
        """Those of them that claim a place to which their robots make progress."""
        limit_ns = self.config.progress_timeout_s * SECOND_NS
        return [
            claim
            for claim in self.present(now_ns)
            if claim.place is not None
            and now_ns - self._received[claim.robot].progress_ns <= limit_ns
        ]

    def _is_recent(self, received: _Received, now_ns: int) -> bool:
        return now_ns - received.received_ns <= self.config.claim_timeout_s * SECOND_NS


def _planned_m(claim: Claim) -> float:
    """Rest of the path, infinite before it is planned: the first plan is progress."""
    return claim.remaining_m or math.inf


def is_same_place(a: Place | None, b: Place | None) -> bool:
    """Whether two claims are of the same place, or both of none."""
    if a is None or b is None:
        return a is b
    return math.dist(a, b) <= SAME_PLACE_M
