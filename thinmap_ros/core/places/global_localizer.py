"""Global localization: samples all over a finished map, weighed by scans until one is left."""

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import config_or_default
from thinmap_ros.core.errors import InputError, quoted, require_type
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.places.hypotheses import (
    ODOMETRY_NOISE,
    Hypotheses,
    KeyView,
    candidates,
    look_at,
    looks_before,
)
from thinmap_ros.core.places.likelihood import HEADING_NOISE_RAD, Judge
from thinmap_ros.core.places.place_database import (
    GlobalLocalizationConfig,
    Observation,
    Places,
    calibrate,
    observe,
    observed_beams,
    random_pose,
    simulated_scan,
)
from thinmap_ros.core.places.place_odds import (
    IN_THIS_MAP,
    SURE,
    MissingShares,
    log_odds_of_any,
    log_odds_of_first,
)
from thinmap_ros.core.scan import Scan, few_beams_reason
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap

# Scans simulated in the map: where walls are smooth, few places leave anything unexplained.
_TRIALS = 400

# What look-alike places leave unexplained, in addition to what the right one does: so many times as
# much, and at least and at most so much. Bare walls explain the same share everywhere, at wrong
# places, too: there it takes more looks.
_ALIKE_TIMES = 10.0
_LEAST_ALIKE = 0.003
_MOST_ALIKE = 0.3


def measured_looks(
    places: Places,
    judge: Judge,
    like: Scan,
    config: GlobalLocalizationConfig,
    rng: np.random.Generator,
) -> MissingShares:
    """What the map leaves unexplained of a scan from the right place, of what it tells of.

    like: a scan of the laser in question. Scans are made in the map at random poses, with noise,
    and compared from poses that are as far off as those of a hypothesis where all is well. Smooth
    walls round empty rooms explain nearly all; a map in which there are legs of chairs, and edges
    wherever somebody went by, a good deal less.
    """
    unexplained = 0.0
    told = 0.0
    for _ in range(_TRIALS):
        T = random_pose(places, rng)
        scan = simulated_scan(places, T, like)
        noisy = scan.ranges_m + rng.normal(0.0, config.beam_noise_m, scan.ranges_m.size)
        seen = observed_beams(replace(scan, ranges_m=noisy), config)
        noise = (config.map_noise_m, config.map_noise_m, HEADING_NOISE_RAD)
        off = rng.normal(size=3) * noise
        explained, silent = judge.explained((T + off)[None], seen)
        told += len(seen.ranges_m) - float(silent[0])
        unexplained += len(seen.ranges_m) - float(silent[0] + explained[0])
    rough = unexplained / max(told, 1.0)
    right = max(rough, 0.5 / config.max_beams)  # less cannot be seen
    more = min(max(_ALIKE_TIMES * rough, _LEAST_ALIKE), _MOST_ALIKE)
    return MissingShares(right, right + more)


# Updates from about the same place meet the same errors of the map; they are independent after so
# much motion. After less than a share of it, a scan shows the same again.
_NEW_WAY_M = 0.5
_NEW_TURN_RAD = 0.5
_LEAST_NOVELTY = 0.2

_VIEWS = 6

# Samples whose beams are followed: the best of those from the whole map, and those of places whose
# likeliest pose leaves some unexplained.
_FOLLOWED = 300

LIKELY = 0.05  # of the weight of the best: a place that is in question

# Odometry that moves farther from one scan to the next has been reset, or the robot was carried.
_JUMP_M = 1.5
_JUMP_RAD = 2.0

# A search that looked at all of the map and did not find the right place: this often.
_LOG_MISSED = math.log(0.3)

_STANDING_NOISE = (0.01, 0.005)  # m, rad: samples do not fall together


class SearchState(IntEnum):
    """How the search stands."""

    WAITING = 0
    SEARCHING = 1
    AMBIGUOUS = 2
    LOCALIZED = 3
    NOT_IN_MAP = 4


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """A place where the robot may be.

    T_map_base (3,), covariance (3, 3), weight, and share of beams of the last look it explains.
    """

    T_map_base: Array
    covariance: Array
    weight: float
    explained: float


@dataclass(frozen=True, eq=False)
class Result:
    """What is known after a step.

    The state, why in words, and the hypotheses, the likeliest first.
    """

    state: SearchState
    reason: str
    hypotheses: tuple[PoseHypothesis, ...]

    @property
    def pose(self) -> PoseHypothesis | None:
        """The one place where the robot is, once it is sure; None before."""
        return self.hypotheses[0] if self.state == SearchState.LOCALIZED else None


class GlobalLocalization:
    """Finds a robot in a map that it may be in, at any place and heading.

    The same seed gives the same answers.

    1. Samples of x, y and heading are drawn over all places where the robot can stand.
    2. All count the same.
    3.-5. For each, the nodes are taken that the map has in sight within the active window, and
       compared with those of the current scan's topological map by distance and angle.
    6. Bayes' rule weighs them, and odometry moves them.

    With one or a few candidates left, sampling continues around these only.

    Beyond the paper: the ranges of the scan are compared with each traversable cell of the map, so
    that corridors, halls and scans without nodes contribute. Candidates must explain the whole
    length of each beam. Each has its own samples, so that none disappears by chance. Equal evidence
    leaves candidates equally likely. A pose is accepted by its odds against all other places and
    against none of them, and with a small covariance.
    Source: topological map paper section 3.1.
    """

    def __init__(
        self,
        patch: GridPatch,
        topology: TopologicalMap,
        config: GlobalLocalizationConfig | None = None,
        seed: int = 0,
        elsewhere: float = IN_THIS_MAP,
    ) -> None:
        """Search a map.

        elsewhere: prior log odds that the robot is nowhere in it.
        Raises InputError where it has no wall, no free place, or the topology no node.
        """
        require_type('patch', patch, GridPatch)
        require_type('topology', topology, TopologicalMap)
        self.config = config_or_default(config, GlobalLocalizationConfig)
        self.places = Places.of(patch, topology, self.config)
        self._rng = np.random.default_rng(seed)
        self._judge: Judge | None = None
        self._dropping: set[str] = set()  # frames of the lasers that drop out
        self._model: MissingShares | None = None
        self._elsewhere = elsewhere
        self._accepted = math.log(self.config.accept_odds)
        self.restart()

    def restart(self) -> None:
        """Forget everything but the map."""
        self._known = Hypotheses.none()
        self._views: list[KeyView] = []
        self._T_step: Array | None = None
        self._T_look: Array | None = None
        self._since_search = math.inf
        self._crowd = 1.0  # how many places looked alike at the most, counted by their weights
        self._updates = 0.0  # since there are places that explain what is seen
        self._searches = 0  # that were complete
        self._drawn = self._draw(self.config.samples)

    @property
    def samples(self) -> Array:
        """The samples (N, 3) as of the last update."""
        return self._known.samples if len(self._known) else self._drawn

    def step(self, scan: Scan, T_odom_base: Array) -> Result:
        """Process a scan with the odometry pose (3,) at its stamp."""
        require_type('scan', scan, Scan)
        if np.shape(T_odom_base) != (3,):
            raise InputError(f'T_odom_base = {quoted(T_odom_base)}: expected a pose (3,)')
        if not se2.is_finite(T_odom_base):
            return self._waiting(f'odometry {T_odom_base.tolist()}: expected finite numbers')
        if self._jumped(T_odom_base):
            self.restart()
            self._T_step = T_odom_base
            return self._waiting('odometry has jumped: the search is reset')
        self._T_step = T_odom_base
        if scan.drops_out and scan.frame not in self._dropping:
            # So far beams without return have spoken for open space.
            self.restart()
            self._T_step = T_odom_base
        others = self._dropping - {scan.frame}
        self._dropping = others | {scan.frame} if scan.drops_out else others
        blind_reason = scan.blind_reason or few_beams_reason(scan)
        if blind_reason or not (scan.returned | scan.no_return).any():
            reason = blind_reason or 'no beam shows anything'
            return self._waiting(f'scan at {scan.stamp_ns} ns: laser blind ({reason})')
        novelty = self._novelty(T_odom_base)
        if novelty > 0.0:
            self._look(scan, T_odom_base, novelty)
        return self._result(T_odom_base)

    def _jumped(self, T_odom_base: Array) -> bool:
        if self._T_step is None:
            return False
        motion = se2.between(self._T_step, T_odom_base)
        far = math.hypot(motion[0], motion[1]) > _JUMP_M
        return far or abs(float(motion[2])) > _JUMP_RAD

    def _novelty(self, T_odom_base: Array) -> float:
        """How much of an independent update this is, 0 to 1.

        0: none, the robot is where it was at the last update.
        """
        if self._T_look is None:
            return 1.0
        motion = se2.between(self._T_look, T_odom_base)
        way = math.hypot(motion[0], motion[1])
        turn = abs(float(motion[2]))
        novelty = way / _NEW_WAY_M + turn / _NEW_TURN_RAD
        return 0.0 if novelty < _LEAST_NOVELTY else min(1.0, novelty)

    def _look(self, scan: Scan, T_odom_base: Array, novelty: float) -> None:
        """One update: move, search if that is due, weigh, drop what does not explain the scan."""
        judge, model = self._ready(scan)
        seen = observe(scan, self.places.frame.resolution, self.config)
        self._advance(T_odom_base)
        self._since_search += novelty
        self._updates += novelty
        if self._log_odds_of_any() < 0.0:
            self._updates = 0.0
        # Earlier views are those of the searches: they tell of all of the way.
        if self._since_search >= max(1.0, self._updates / _VIEWS) and not self.is_sure:
            self._search(judge, model, seen, T_odom_base)
        known = self._known
        if len(known):
            known.poses = self._refined(judge, seen)
            known.take_evidence(look_at(model, judge, known.poses, seen), novelty, self._most)
            known.prune()
            known.resample(None, self.config.samples, self._rng) if not len(known.samples) else None
            logs = judge.log_likelihoods(known.samples, seen)
            known.weigh(logs)
            known.resample(logs, self.config.samples, self._rng)
        if len(known):
            self._crowd = max(self._crowd, float(np.exp(known.log_weights).sum()))
        self._T_look = T_odom_base

    def _refined(self, judge: Judge, seen: Observation) -> Array:
        """Poses (H, 3) of the hypotheses where this scan fits best.

        Samples that fit lead out of a dead end.
        """
        known = self._known
        if not len(known.samples):
            return judge.refined(known.poses, seen, known.covariances)
        others = known.best_samples(judge.log_likelihoods(known.samples, seen))
        poses = judge.refined(known.poses, seen, known.covariances, others)
        return judge.unblocked(poses, seen, known.some_samples(_FOLLOWED))

    def _ready(self, scan: Scan) -> tuple[Judge, MissingShares]:
        """The judge, and what a look is worth; the first scan tells for which laser."""
        if self._judge is None or self._model is None:
            nodes = calibrate(self.places, scan, self.config, self._rng)
            self._judge = Judge(self.places, self.config, nodes)
            self._model = measured_looks(self.places, self._judge, scan, self.config, self._rng)
        return self._judge, self._model

    def _advance(self, T_odom_base: Array) -> None:
        """Move hypotheses and samples with the odometry since the last update."""
        if self._T_look is None:
            return
        motion = se2.between(self._T_look, T_odom_base)
        way = math.hypot(motion[0], motion[1])
        turn = abs(float(motion[2]))
        noise = ODOMETRY_NOISE
        spread = (noise * way + _STANDING_NOISE[0], noise * (way + turn) + _STANDING_NOISE[1])
        self._known.move(motion, spread, self._rng)
        self._drawn = se2.compose_each(self._drawn, motion[None])

    def _search(
        self, judge: Judge, model: MissingShares, seen: Observation, T_odom_base: Array
    ) -> None:
        """Search for places all over the map that explain this scan and those before it."""
        self._since_search = 0.0
        self._drawn = self._draw(self.config.samples)
        logs = judge.log_likelihoods(self._drawn, seen)
        drawn = self._drawn[np.argsort(-logs, kind='stable')[:_FOLLOWED]]
        found, complete = candidates(self.places, judge, seen, drawn, self._rng)
        if len(found):
            poses = np.concatenate([self._known.poses, found])
            looks = looks_before(judge, model, self._views, poses, T_odom_base)
            self._known.add(found, self._log_prior, looks, self._most)
        self._searches += complete
        self._views = [*self._views[-_VIEWS + 1 :], KeyView(seen, T_odom_base)]

    @property
    def _log_prior(self) -> float:
        """Log odds of a place that turns up late, against those that are known, and none."""
        return max(self._searches * _LOG_MISSED, -SURE)

    def _draw(self, count: int) -> Array:
        """Samples (N, 3) of all poses at which the robot can stand."""
        places = self.places
        cells = places.standing[self._rng.integers(len(places.standing), size=count)]
        at = places.frame.centres_of(cells.astype(np.int64))
        at += self._rng.uniform(-0.5, 0.5, at.shape) * places.frame.resolution
        return np.column_stack([at, self._rng.uniform(-np.pi, np.pi, count)])

    @property
    def _most(self) -> float:
        """Evidence of a place of which the robot is sure."""
        return math.log(self._crowd) + SURE

    @property
    def log_odds(self) -> float:
        """Log odds of the likeliest place, against the others and against none of the map."""
        known = self._known
        if not len(known):
            return -math.inf
        order = known.order()
        likely = known.evidence[order[0]] + known.log_weights
        evidence = np.minimum(known.evidence, likely)[order]
        return log_odds_of_first(evidence, math.log(self._crowd), self._elsewhere)

    def _log_odds_of_any(self) -> float:
        """Log odds that one of the places is the right one, against none of them.

        A robot that has driven out of what is mapped is at none of its places.
        """
        known = self._known
        alternatives = math.log(self._crowd)
        here = self.places.are_free(known.poses[:, :2])
        outside = known.evidence[~here] - alternatives
        elsewhere = float(np.logaddexp.reduce(outside, initial=self._elsewhere))
        return log_odds_of_any(known.evidence[here], alternatives, elsewhere)

    @property
    def is_sure(self) -> bool:
        """Whether the odds of a place suffice, and it is known closely enough."""
        return self.log_odds >= self._accepted and self._known.is_narrow(self._known.best())

    def _waiting(self, reason: str) -> Result:
        return Result(SearchState.WAITING, reason, ())

    def _result(self, T_odom_base: Array) -> Result:
        known = self._known
        if not len(known):
            return Result(
                SearchState.SEARCHING, 'the scans show too little to tell places apart', ()
            )
        motion = np.zeros(3) if self._T_look is None else se2.between(self._T_look, T_odom_base)
        poses = se2.compose_each(known.poses, motion[None])
        weights = known.weights
        hypotheses = tuple(
            PoseHypothesis(poses[k], known.covariances[k], float(weights[k]), float(known.found[k]))
            for k in known.order().tolist()
        )
        if self.is_sure:
            reason = f'one place, log odds {self.log_odds:.1f}'
            return Result(SearchState.LOCALIZED, reason, hypotheses)
        in_map = self._log_odds_of_any()
        if in_map <= -self._accepted:
            reason = f'no place explains what was seen, log odds {in_map:.1f}'
            return Result(SearchState.NOT_IN_MAP, reason, hypotheses)
        likely = int((weights >= LIKELY * weights.max()).sum())
        if likely > 1:
            return Result(
                SearchState.AMBIGUOUS, f'{likely} places explain what was seen', hypotheses
            )
        reason = f'one place, not yet sure: log odds {self.log_odds:.1f}'
        return Result(SearchState.SEARCHING, reason, hypotheses)
