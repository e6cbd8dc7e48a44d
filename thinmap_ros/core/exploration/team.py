"""A robot's view of its team: what others claim and change, and which candidates are its own."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.exploration.belief import Evidence
from thinmap_ros.core.exploration.candidates import Candidate
from thinmap_ros.core.planning.travel_times import TravelTimes
from thinmap_ros.core.se2 import SECOND_NS, Array, Place

Message = TypeVar('Message')

NOTHING = -1
_TIE_S = 0.2  # times that differ less are equal
_CLAIM_RADIUS_M = 2.0  # a candidate belongs to a claim of a place within this distance
_MAX_CANDIDATES = 40  # in an auction; the nearest ones

SAME_PLACE_M = 0.5  # a claimed place that moves less is the same one
MAX_SETTLED = 8  # places in a claim
_PROGRESS_S = 1.0


def auction(
    seconds: Array, claimed: NDArray[np.int64], told_s: Array, margin_s: float
) -> NDArray[np.int64]:
    """Candidate (R,) that each robot explores, NOTHING where there are fewer candidates.

    Each robot decides this alone from the claims of all. Pairs of robot and candidate are formed,
    the shortest time first, one candidate for each robot. A robot keeps what it has claimed unless
    another one is clearly sooner there.
    seconds (R, N): time from each robot to each candidate, robots in the order in which ties are
    decided; claimed (R,): the candidate that each has claimed, or NOTHING; told_s (R,): time to it
    that each has sent to the others; margin_s: a claimed candidate counts as reached so much
    sooner.
    Sources: Zlot et al., "Multi-robot exploration controlled by a market economy", 2002; Werger and
    Mataric, "Broadcast of local eligibility", 2000.
    """
    robots, count = seconds.shape
    bids = np.round(seconds / _TIE_S)
    holders = [r for r in range(robots) if _holds(r, claimed, told_s, margin_s)]
    bids[holders, claimed[holders]] -= margin_s / _TIE_S
    won = np.full(robots, NOTHING, dtype=np.int64)
    for _ in range(min(robots, count)):
        # Of equal bids the first robot's.
        robot, candidate = np.unravel_index(int(bids.argmin()), bids.shape)
        won[robot] = candidate
        bids[robot, :] = np.inf
        bids[:, candidate] = np.inf
    return won


def _holds(robot: int, claimed: NDArray[np.int64], told_s: Array, margin_s: float) -> bool:
    """Whether a robot's claim counts: of several on one candidate only that of the first there.

    The first by what they have sent: each knows its own pose sooner than those of the others, and
    would take itself for the first. What they have sent is some seconds old: of two that differ by
    less than the margin the first robot's counts.
    """
    candidate = int(claimed[robot])
    if candidate == NOTHING:
        return False
    rivals = np.flatnonzero(claimed == candidate)
    return int(rivals[told_s[rivals] <= told_s[rivals].min() + margin_s][0]) == robot


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


class Heard(Generic[Message]):
    """The newest message of each other robot, as long as the robot is not silent."""

    def __init__(self, config: SilenceConfig) -> None:
        self.config = config
        self._newest: dict[str, tuple[Message, int]] = {}

    def add(self, robot: str, message: Message, now_ns: int) -> None:
        """Add a message of a robot, received now."""
        self._newest[robot] = (message, now_ns)

    def lately(self, now_ns: int) -> list[tuple[Message, float]]:
        """Messages of the robots that were received recently, and their ages, s."""
        newest = self._newest.values()
        aged = [(message, (now_ns - then_ns) / SECOND_NS) for message, then_ns in newest]
        return [each for each in aged if 0.0 <= each[1] <= self.config.claim_timeout_s]


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

    It names the place of a frontier and no id of a node, so that each robot can have a graph of its
    own. It holds as long as its robot is received and comes nearer to the place.
    robot: its name; stamp_ns: by its own clock; pose (3,); place: of the frontier that it drives
    to, m, None without a target; remaining_s: time until it is there, 0 where that is not known;
    settled: its latest places.
    """

    robot: str
    stamp_ns: int
    pose: Array
    place: Place | None = None
    remaining_s: float = 0.0
    settled: tuple[SettledPlace, ...] = ()


@dataclass
class _Received:
    """A claim, when it came and when its robot made progress, by this robot's clock, ns.

    least_s: smallest remaining time to the claimed place.
    """

    claim: Claim
    received_ns: int
    progress_ns: int
    least_s: float


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
            self._received[claim.robot] = _Received(claim, now_ns, now_ns, _known_s(claim))
            return
        if claim.stamp_ns <= last.claim.stamp_ns:
            return
        is_nearer = _known_s(claim) < last.least_s - _PROGRESS_S
        if is_nearer or not is_same_place(claim.place, last.claim.place):
            last.progress_ns = now_ns
            last.least_s = _known_s(claim)
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


def _known_s(claim: Claim) -> float:
    """Remaining time, infinite before it is known: the first one is progress."""
    return claim.remaining_s or math.inf


def is_same_place(a: Place | None, b: Place | None) -> bool:
    """Whether two claims are of the same place, or both of none."""
    if a is None or b is None:
        return a is b
    return math.dist(a, b) <= SAME_PLACE_M


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
        self, candidates: list[Candidate], own: Claim, travel: TravelTimes, margin_s: float
    ) -> list[Candidate]:
        """The candidates that are this robot's: one by auction, or the nearest one to follow.

        own: what this robot claims now; travel: in the map of all; margin_s: saving for which a
        claim is given up. A robot that claims nothing, or makes no progress, does not bid: it has
        put aside what is left.
        """
        others = self.claims.held(own.stamp_ns)
        if not others or not candidates:
            return candidates
        bidders = sorted([own, *others], key=lambda claim: claim.robot)
        me = bidders.index(own)
        goals = np.array([candidate.goal for candidate in candidates])
        seconds = np.array([travel.seconds_from(claim.pose, goals) for claim in bidders])
        near = np.argsort(seconds.min(axis=0), kind='stable')[:_MAX_CANDIDATES]
        middles = np.array([candidates[i].middle for i in near])
        claimed = _claimed(middles, [claim.place for claim in bidders])
        told_s = np.array([claim.remaining_s for claim in bidders])
        told_s[me] = self._told_s(own)
        won = int(auction(seconds[:, near], claimed, told_s, margin_s)[me])
        if won != NOTHING:
            return [candidates[near[won]]]
        nearest = int(seconds[me].argmin())
        follows = 0.0 < self.config.follow_m < seconds[me, nearest] * travel.speed_m_s
        return [candidates[nearest]] if follows else []

    def _told_s(self, own: Claim) -> float:
        """Time to the claimed place that the others know; infinite: they know of none."""
        sent = self.sent
        is_sent = sent is not None and is_same_place(sent.place, own.place)
        return sent.remaining_s if sent is not None and is_sent else math.inf


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
