"""A robot's view of its team: what others claim and change, and which candidates are its own."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.config import parameter
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.exploration.belief.evidence import Evidence
from thinmap_ros.core.exploration.candidates import Candidate
from thinmap_ros.core.exploration.team.auction import NOTHING, auction
from thinmap_ros.core.exploration.team.claims import (
    Claim,
    ClaimConfig,
    Claims,
    Place,
    SettledPlace,
    is_same_place,
)
from thinmap_ros.core.se2 import Array

_CLAIM_RADIUS_M = 2.0  # a candidate belongs to a claim of a place within this distance
_MAX_CANDIDATES = 40  # in an auction; the nearest ones
MAX_SETTLED = 8  # places in a claim
LengthsFrom = Callable[[Array, Array], Array]
"""Path lengths (N,), m, from a pose (3,) to goals (N, 2)."""


@dataclass(frozen=True)
class TeamConfig(ClaimConfig):
    """How a robot explores with others."""

    follow_m: float = parameter(
        5.0,
        'A robot for which no candidate is left follows the others up to this distance from the '
        'nearest candidate (m). 0: it waits, which saves distance and takes longer.',
        low=0.0,
        high=1000.0,
    )


class Team:
    """What one robot has received of the others; without any of them it has all candidates.

    name: of this robot; two robots of a team never have the same. sent: its last claim, as the
    others were told it.
    """

    def __init__(self, name: str = '', config: TeamConfig | None = None) -> None:
        self.name = name
        self.config = config or TeamConfig()
        self.claims = Claims(self.config)
        self.sent: Claim | None = None
        self._boxes: list[Array] = []
        self._settled: list[SettledPlace] = []

    @property
    def settled(self) -> tuple[SettledPlace, ...]:
        """The latest places that this robot has settled, for its claims."""
        return tuple(self._settled)

    def add_claim(self, claim: Claim, now_ns: int) -> None:
        """Add what another robot claims, received now.

        Raises InputError where that robot has this one's name.
        """
        if claim.robot == self.name:
            raise InputError(
                f'claim of robot {quoted(claim.robot)}: expected another name than this robot has'
            )
        self.claims.add(claim, now_ns)

    def add_changes(self, box: Array) -> None:
        """Add a part of the map that another robot has changed: its corners (2, 2), m."""
        self._boxes.append(box)

    def take_changes(self) -> list[Array]:
        """Parts of the map that others have changed since the last call."""
        boxes = self._boxes
        self._boxes = []
        return boxes

    def add_settled(self, evidence: Evidence) -> None:
        """Report to the others how often a place was visited, and no path was found to it."""
        x, y = evidence.place
        kept = [place for place in self._settled if (place.x, place.y) != (x, y)]
        kept.append(SettledPlace(x, y, evidence.visits, evidence.failures))
        self._settled = kept[-MAX_SETTLED:]

    def apply_settled(self, items: Sequence[Evidence], reach_m: float, now_ns: int) -> None:
        """Add to the evidence about places what the others have settled within a distance of it.

        A place that a robot has visited can be reached, whatever others have found.
        """
        for claim in self.claims.present(now_ns):
            for place in claim.settled:
                item = _nearest(items, (place.x, place.y), reach_m)
                if item is None:
                    continue
                item.visits = max(item.visits, place.visits)
                if item.visits == 0 and place.failures > item.failures:
                    item.failures = place.failures
                    item.failed_ns = now_ns

    def share(
        self, candidates: list[Candidate], own: Claim, lengths_from: LengthsFrom, margin_m: float
    ) -> list[Candidate]:
        """The candidates that are this robot's: one by auction, or the nearest one to follow.

        own: what this robot claims now; margin_m: saving for which a claim is given up. A robot
        that claims nothing, or makes no progress, does not bid: it has put aside what is left.
        """
        others = self.claims.held(own.stamp_ns)
        if not others or not candidates:
            return candidates
        bidders = sorted([own, *others], key=lambda claim: claim.robot)
        me = bidders.index(own)
        goals = np.array([candidate.goal for candidate in candidates])[:, :2]
        lengths = np.array([lengths_from(claim.pose, goals) for claim in bidders])
        near = np.argsort(lengths.min(axis=0), kind='stable')[:_MAX_CANDIDATES]
        middles = np.array([candidates[i].middle for i in near])
        claimed = _claimed(middles, [claim.place for claim in bidders])
        told_m = np.array([claim.path_m for claim in bidders])
        told_m[me] = self._told_m(own)
        won = int(auction(lengths[:, near], claimed, told_m, margin_m)[me])
        if won != NOTHING:
            return [candidates[near[won]]]
        nearest = int(lengths[me].argmin())
        follows = 0.0 < self.config.follow_m < lengths[me, nearest]
        return [candidates[nearest]] if follows else []

    def _told_m(self, own: Claim) -> float:
        """Path length to the claimed place that the others know; infinite: they know of none."""
        sent = self.sent
        is_sent = sent is not None and is_same_place(sent.place, own.place)
        return sent.path_m if sent is not None and is_sent else math.inf


def _nearest(items: Iterable[Evidence], place: Place, reach_m: float) -> Evidence | None:
    near = [item for item in items if math.dist(item.place, place) <= reach_m]
    return min(near, key=lambda item: math.dist(item.place, place), default=None)


def _claimed(middles: Array, places: Sequence[Place | None]) -> NDArray[np.int64]:
    """Index of the candidate (N, 2), m, that belongs to each claimed place, (R,)."""
    claimed = np.full(len(places), NOTHING, dtype=np.int64)
    for robot, place in enumerate(places):
        if place is None:
            continue
        away = np.hypot(*(middles - place).T)
        nearest = int(away.argmin())
        if away[nearest] <= _CLAIM_RADIUS_M:
            claimed[robot] = nearest
    return claimed
