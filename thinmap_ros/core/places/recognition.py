"""Whether a growing piece of map lies in another one: hypotheses, their odds, the decision.

Each view of the piece is looked for in the whole map. What is found is a hypothesis. Each is judged
by all views. "None of these places" is a hypothesis, too: its odds follow from the number of poses
that the map has. Maps bend: a hypothesis has a pose for each view, near to the one that the next
view along the path predicts. This is pairwise consistency along the path: Mangelson et al.,
"Pairwise consistent measurement set maximization for robust multi-robot map merging", 2018.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.moved import MapMotion
from thinmap_ros.core.places.piece import (
    SAME_M,
    SAME_RAD,
    Landmarks,
    MapPiece,
    agree,
    are_same,
    drift_m,
)
from thinmap_ros.core.places.place_odds import (
    JOIN_ODDS,
    MAY_BE_ELSEWHERE,
    MIN_KNOWN,
    OTHER_PLACES,
    Shares,
    limited,
    log_odds_of_first,
    log_ratios,
    on_one_storey,
)
from thinmap_ros.core.places.structure import storey_evidence, structure_evidence
from thinmap_ros.core.places.views import SPACING_M, WINDOW_M, View
from thinmap_ros.core.places.wall_field import BASIN_M
from thinmap_ros.core.se2 import Array, inverse
from thinmap_ros.core.stage import are_two_storeys

# Share of its walls that a view finds again at the right place, in the map of another visit.
# Measured: median 0.80, 5 % quantile 0.54.
_HERE = Shares(0.8, 0.12)

_MAX_STARTS = 3  # to either side
_SEED = 0


class Evidence(NamedTuple):
    """Log likelihood ratio of a place against other places, and the share of walls found there."""

    log_ratio: float
    found: float


NONE = Evidence(0.0, 0.0)


class ViewJudge:
    """Tells how likely it is that views of another piece were taken at places of a map."""

    def __init__(self, piece: MapPiece, rng: np.random.Generator) -> None:
        self._field = piece.field
        self._rng = rng
        self._elsewhere: dict[int, Shares | None] = {}  # by the number of the view

    def evidence(self, view: View, T_map_view: Array) -> Evidence:
        """Evidence of a view for a pose (3,) in the map.

        A view that was taken there finds its walls again. One that was not finds as many as at
        other places of this very map: those are measured for each view.
        """
        found, known = self._field.agreement(view, T_map_view)
        elsewhere = self._found_elsewhere(view)
        if known < MIN_KNOWN or elsewhere is None:
            return NONE
        return Evidence(float(log_ratios(found, known, _HERE, elsewhere)), found)

    def best_near(self, view: View, T_map_view: Array, path_m: float) -> tuple[Array, Evidence]:
        """The best pose (3,) within the drift from a predicted one, and the evidence for it.

        path_m: length of the path over which the pose is predicted.
        """
        starts = _starts(T_map_view, path_m)
        rough, fits = self._field.refined_widely(view, starts)
        T, _, _ = self._field.refined(view, rough[int(fits.argmax())])
        if not agree(T, T_map_view, path_m):
            T = T_map_view
        evidence = self.evidence(view, T)
        if evidence.log_ratio > 0.0:  # the best of several
            log_ratio = max(evidence.log_ratio - math.log(len(starts)), 0.0)
            evidence = evidence._replace(log_ratio=log_ratio)
        return T, evidence

    def _found_elsewhere(self, view: View) -> Shares | None:
        """Share of walls found at random places of the map; None if it tells of too few."""
        if view.number not in self._elsewhere:
            field = self._field
            anywhere = field.random_poses(OTHER_PLACES, self._rng)
            poses, _ = field.refined_widely(view, anywhere)
            pairs = [field.agreement(view, T) for T in poses]
            shares = [found for found, known in pairs if known >= MIN_KNOWN]
            known = Shares.of(shares, _HERE.sigma) if shares else None
            self._elsewhere[view.number] = known
        return self._elsewhere[view.number]


def _starts(T: Array, path_m: float) -> Array:
    """Poses (N, 3) from which refinements reach all that drift over a path makes possible."""
    count = min(int(drift_m(path_m) / BASIN_M), _MAX_STARTS)
    steps = np.arange(-count, count + 1) * BASIN_M
    x, y = np.meshgrid(steps, steps)
    offsets = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return np.asarray(T + offsets)


_INDEPENDENT = SPACING_M / WINDOW_M  # share of a view that is in no other one

# How often a search over the whole map leads to the right place, and again to a wrong one.
_FOUND_AGAIN = 0.9
_WRONG_AGAIN = 0.05
_FOUND_BY_SEARCH = math.log(_FOUND_AGAIN / _WRONG_AGAIN)
_NOT_FOUND_BY_SEARCH = math.log1p(-_FOUND_AGAIN) - math.log1p(-_WRONG_AGAIN)

_PLACES_OF_A_VIEW = 3

_MAX_HYPOTHESES = 12

_MAX_VIEWS = 20  # by which a new hypothesis is judged: bounds the time of a view

MATCH_NOISE = np.diag([0.05**2, 0.05**2, 0.01**2])  # of a match, besides that of its points


@dataclass(eq=False)
class PieceHypothesis:
    """A place of the piece in the map, as a pose T_map_view (3,) for each view that supports it.

    first: number of the view whose search led here first; evidence_of: each view, without the
    evidence of the search; log_ratios: with it, limited.
    """

    first: int
    poses: dict[int, Array] = field(default_factory=dict)
    evidence_of: dict[int, Evidence] = field(default_factory=dict)
    log_ratios: dict[int, float] = field(default_factory=dict)

    @property
    def evidence(self) -> float:
        """Sum of the log likelihood ratios of the views, as far as these are independent."""
        return _INDEPENDENT * sum(self.log_ratios.values())

    def record(
        self, view: View, T_map_view: Array, evidence: Evidence, by_search: float = 0.0
    ) -> None:
        """Record the evidence of a view for a pose (3,) in the map, and that of its search."""
        log_ratio = evidence.log_ratio + by_search
        self.log_ratios[view.number] = float(limited(log_ratio))
        self.evidence_of[view.number] = evidence
        if log_ratio > 0.0:
            self.poses[view.number] = T_map_view

    def meets(self, other: 'PieceHypothesis') -> bool:
        """Whether both place a view alike: they are one place, from which one of them departed."""
        shared = list(self.poses.keys() & other.poses.keys())
        poses = np.array([self.poses[k] for k in shared]).reshape(-1, 3)
        others = np.array([other.poses[k] for k in shared]).reshape(-1, 3)
        return bool(are_same(poses, others).any())

    def motion(self, views: Sequence[View]) -> MapMotion:
        """How the piece moves into the map; views: all of it, by number."""
        return MapMotion(
            np.array([views[number].T_piece_view for number in self.poses]),
            np.array([*self.poses.values()]),
        )

    def predicted(self, view: View, views: Sequence[View]) -> tuple[Array, float]:
        """Pose T_map_view (3,) by the nearest view along the path, and the path between both, m.

        views: all of the piece, by number.
        """
        anchor = min(self.poses, key=lambda k: abs(views[k].path_m - view.path_m))
        T_anchor_view = se2.between(views[anchor].T_piece_view, view.T_piece_view)
        path_m = abs(views[anchor].path_m - view.path_m)
        return se2.compose(self.poses[anchor], T_anchor_view), path_m


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a piece lies in a map: T_map_piece (3,) with covariance (3, 3), and the log odds.

    hypothesis: the place of each view.
    """

    T_map_piece: Array
    covariance: Array
    log_odds: float
    hypothesis: PieceHypothesis


class Recognition:
    """Looks for a growing piece of map in another one, view by view."""

    def __init__(self, known: MapPiece) -> None:
        """known: the map in which the piece is looked for; it stays as it is."""
        self.known = known
        self._judge = ViewJudge(known, np.random.default_rng(_SEED))
        self._alternatives = log_alternatives(known)
        self.views: list[View] = []
        self.hypotheses: list[PieceHypothesis] = []
        self._found: list[Array] = []  # poses (N, 3) by the search for each view

    def add(self, view: View, landmarks: Landmarks) -> None:
        """Look for the next view of the piece; landmarks: around the view, in its frame.

        The time is bounded. Views are numbered in their order.
        """
        self.views.append(view)
        found = self.known.find(view, landmarks, _PLACES_OF_A_VIEW)
        self._found.append(found)
        for hypothesis in self.hypotheses:
            self._judge_by(view, hypothesis)
        for T_map_view in found:
            self._propose(view, T_map_view)
        self._prune()

    def placement(
        self, query: MapPiece | None = None, least: float = -math.inf
    ) -> Placement | None:
        """The most likely place, and its odds against all others and none; None without one.

        query: the piece as it is now. Walls that contradict other places count against these, where
        the log odds of the best one against none are above `least`.
        """
        if not self.hypotheses:
            return None
        best = self.hypotheses[0]
        evidence = np.array([each.evidence for each in self.hypotheses])
        likely = evidence - self._alternatives - MAY_BE_ELSEWHERE
        if query is not None and likely[0] > least:
            for k, other in enumerate(self.hypotheses[1:], 1):
                if likely[k] > 0.0:  # one that is less likely than none is no rival
                    ratio = structure_evidence(query, self.known, other.motion(self.views))
                    evidence[k] += min(ratio, 0.0)
        odds = log_odds_of_first(evidence, self._alternatives, MAY_BE_ELSEWHERE)
        return Placement(*self._transform(best), odds, best)

    def _propose(self, view: View, T_map_view: Array) -> None:
        """Make a place where a view was found a hypothesis, or evidence for one."""
        evidence = self._judge.evidence(view, T_map_view)
        if evidence.log_ratio <= 0.0:
            return
        for hypothesis in self.hypotheses:
            if agree(T_map_view, *hypothesis.predicted(view, self.views)):
                if evidence.found > hypothesis.evidence_of[view.number].found:
                    by_search = 0.0 if hypothesis.first == view.number else _FOUND_BY_SEARCH
                    hypothesis.record(view, T_map_view, evidence, by_search)
                return
        hypothesis = PieceHypothesis(view.number)
        hypothesis.record(view, T_map_view, evidence)
        for other in reversed(self.views[-1 - _MAX_VIEWS : -1]):
            self._judge_by(other, hypothesis)
        self.hypotheses.append(hypothesis)

    def _judge_by(self, view: View, hypothesis: PieceHypothesis) -> None:
        """Add the evidence of a view for a hypothesis, at the best pose within the drift."""
        predicted, path_m = hypothesis.predicted(view, self.views)
        T, evidence = self._judge.best_near(view, predicted, path_m)
        by_search = 0.0
        if evidence.found > 0.0:
            is_found = any(agree(found, T, 0.0) for found in self._found[view.number])
            by_search = _FOUND_BY_SEARCH if is_found else _NOT_FOUND_BY_SEARCH
        hypothesis.record(view, T, evidence, by_search)

    def _prune(self) -> None:
        """Keep the best hypotheses, each of another place."""
        kept: list[PieceHypothesis] = []
        for hypothesis in sorted(self.hypotheses, key=lambda each: -each.evidence):
            if not any(hypothesis.meets(better) for better in kept):
                kept.append(hypothesis)
        self.hypotheses = kept[:_MAX_HYPOTHESES]

    def _transform(self, hypothesis: PieceHypothesis) -> tuple[Array, Array]:
        """T_map_piece (3,) by the view with the most evidence, and its covariance (3, 3)."""
        best = max(hypothesis.poses, key=lambda k: hypothesis.evidence_of[k].log_ratio)
        view = self.views[best]
        T, information, _ = self.known.field.refined(view, hypothesis.poses[best])
        covariance = inverse(information + np.eye(3)) + MATCH_NOISE
        return se2.compose(T, se2.invert(view.T_piece_view)), covariance


def log_alternatives(known: MapPiece) -> float:
    """Log of the number of poses in a map that a view tells apart."""
    squares = max(known.free_area_m2 / SAME_M**2, 1.0)
    return math.log(squares * 2.0 * math.pi / SAME_RAD)


def log_odds_back(
    query: MapPiece,
    known: MapPiece,
    views: Sequence[View],
    hypothesis: PieceHypothesis,
) -> float:
    """Log odds of a hypothesis by the views of the map in the piece: the other way round.

    views: of the piece, by number. What a piece shows may fit into a richer map by chance. The
    richer map does not fit into the piece then.
    """
    numbers = list(hypothesis.poses)
    places = np.array([hypothesis.poses[number] for number in numbers])
    judge = ViewJudge(query, np.random.default_rng(_SEED))
    own = PieceHypothesis(0)
    for view in known.views:
        away = np.hypot(*(places[:, :2] - view.T_piece_view[:2]).T)
        nearest = int(away.argmin())
        if away[nearest] > WINDOW_M:
            continue
        T_query_found = views[numbers[nearest]].T_piece_view
        T_query_map = se2.compose(T_query_found, se2.invert(places[nearest]))
        T, evidence = judge.best_near(view, se2.compose(T_query_map, view.T_piece_view), 0.0)
        own.record(view, T, evidence)
    alternatives = log_alternatives(query)
    return log_odds_of_first(np.array([own.evidence]), alternatives, MAY_BE_ELSEWHERE)


@dataclass(frozen=True, eq=False)
class JoinDecision:
    """The most likely place of a piece in a map, or None; whether it is accepted.

    log_odds: of the place by the views of the piece, or by those of the map in the piece if these
    are less, and of one storey; views: how many views of the piece were looked for.
    """

    is_joined: bool
    placement: Placement | None
    log_odds: float
    views: int


def decide(
    recognition: Recognition, query: MapPiece, known: MapPiece, join_odds: float = JOIN_ODDS
) -> JoinDecision:
    """Decide whether a piece lies in a map: by the views of each of the two, and by their walls.

    recognition: of the views of the piece in the map so far; query: the piece as it is now. Pieces
    with different tags are never joined, those with equal ones whatever their walls.
    """
    least = math.log(join_odds)
    placement = recognition.placement(query, least)
    views = recognition.views
    if placement is None or are_two_storeys(query.tag, known.tag):
        return JoinDecision(False, None, -math.inf, len(views))
    odds = placement.log_odds
    if odds > least:
        back = log_odds_back(query, known, views, placement.hypothesis)
        ratio = storey_evidence(query, known, placement.hypothesis.motion(views))
        odds = on_one_storey(min(odds, back), ratio, join_odds)
    return JoinDecision(odds > least, placement, odds, len(views))


def recognize(query: MapPiece, known: MapPiece, join_odds: float = JOIN_ODDS) -> JoinDecision:
    """Look for all views of a piece in a map, and decide by all of them."""
    recognition = Recognition(known)
    for view in query.views:
        recognition.add(view, query.landmarks.around(view))
    return decide(recognition, query, known, join_odds)
