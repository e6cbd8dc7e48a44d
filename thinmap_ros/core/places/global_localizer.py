"""Global localization: samples all over a finished map, weighed by scans until one is left."""

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import config_or_default
from thinmap_ros.core.errors import InputError, quoted, require_type
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.places.hypotheses import (
    ODOMETRY_NOISE,
    Hypotheses,
    KeyView,
    candidates,
    judged_before,
    missed_beams,
    moved,
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
from thinmap_ros.core.scan import Scan, few_beams_reason
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap

# Scans simulated in the map: where walls are smooth, few places leave anything unexplained.
_TRIALS = 400

_MIN_RATIO = 0.7  # whatever the map looks like: what explains less is not the right place


def usual_share(
    places: Places,
    judge: Judge,
    like: Scan,
    config: GlobalLocalizationConfig,
    rng: np.random.Generator,
) -> float:
    """Share of beams that the map explains from the right place, of those it says something about.

    like: a scan of the laser in question. Scans are made in the map at random poses, with noise,
    and compared from poses that are as far off as those of a hypothesis where all is well. Smooth
    walls round empty rooms explain nearly all; a map in which there are legs of chairs, and edges
    wherever somebody went by, a good deal less.
    """
    counts = 0.0
    asked = 0.0
    for _ in range(_TRIALS):
        T = random_pose(places, rng)
        scan = simulated_scan(places, T, like)
        noisy = scan.ranges_m + rng.normal(0.0, config.beam_noise_m, scan.ranges_m.size)
        seen = observed_beams(replace(scan, ranges_m=noisy), config)
        noise = (config.map_noise_m, config.map_noise_m, HEADING_NOISE_RAD)
        off = rng.normal(size=3) * noise
        explained, silent = judge.explained((T + off)[None], seen)
        counts += float(explained[0])
        asked += len(seen.ranges_m) - float(silent[0])
    return max(counts / max(asked, 1.0), _MIN_RATIO)


# Nearer to the last update, a scan shows the same again.
_LOOK_M = 0.1
_LOOK_RAD = 0.1

# Updates from about the same place meet the same errors of the map; they are independent after so
# much motion.
_NEW_WAY_M = 0.5
_NEW_TURN_RAD = 0.5

# Independent updates that a place must have explained: more for each e-fold of places that looked
# alike, and for each update before it turned up. An update counts the less, the more it leaves
# unexplained of what it should explain in this map, and nothing from a share on: so many times what
# the right one leaves unexplained there (no less than the least, as few scans were made in the map;
# no more than the most), and more in rough maps, which draw things in part.
_SURE_UPDATES = 1.0
_SURE_UPDATES_CROWD = 0.75
_SURE_UPDATES_LATE = 2.0
_WORTHLESS_TIMES = 10.0
_MIN_WORTHLESS = 0.0075
_MAX_WORTHLESS = 0.03
_WORTHLESS_ROUGH = 0.5

# After so many independent updates, a place that explains must have lasted for this share of them,
# but not for ever.
_MANY_UPDATES = 16.0
_LASTING_SHARE = 0.4
_LASTING_UPDATES = 20.0

# Largest standard deviations of an accepted pose: half the basin of convergence of scan matching.
_SURE_M = 0.15
_SURE_RAD = 0.07

_VIEWS = 6

_FRESH_SHARE = 0.2  # of the samples: drawn from the whole map during the search

_FRESH_BEST = 100

# Samples whose beams are followed, where the likeliest pose of a place leaves some unexplained.
_LOOKED_ALONG = 300

# Odometry that moves farther from one scan to the next has been reset, or the robot was carried.
_JUMP_M = 1.5
_JUMP_RAD = 2.0

_STANDING_NOISE = (0.01, 0.005)  # m, rad: samples do not fall together

# A search that looked at all of the map and did not find the right place: this often. So who turns
# up late is unlikely, but what one search misses the next ones may miss for the same reason: so
# often they all do.
_LOG_MISSED = math.log(0.3)

_MIN_LOG_PRIOR = math.log(0.05)

_TRUST_FROM = 0.6  # share of the beams that must be explained for that

# Updates: once all places are known, the map is searched less often.
_FIRST_SEARCHES = 6

_LATER_EVERY = 4.0


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

    T_map_base (3,), covariance (3, 3), weight, and share of beams it explains.
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
    leaves candidates equally likely. A pose is accepted only if it explains the scans, has no other
    candidate beside it, and has a small covariance.
    Source: topological map paper section 3.1.
    """

    def __init__(
        self,
        patch: GridPatch,
        topology: TopologicalMap,
        config: GlobalLocalizationConfig | None = None,
        seed: int = 0,
    ) -> None:
        """Search a map.

        Raises InputError where it has no wall, no free place, or the topology no node.
        """
        require_type('patch', patch, GridPatch)
        require_type('topology', topology, TopologicalMap)
        self.config = config_or_default(config, GlobalLocalizationConfig)
        self.places = Places.of(patch, topology, self.config)
        self._rng = np.random.default_rng(seed)
        self._judge: Judge | None = None
        self._dropping: set[str] = set()  # frames of the lasers that drop out
        self._usual = 1.0  # share that the right place explains in this map
        self.restart()

    def restart(self) -> None:
        """Forget everything but the map."""
        self._known = Hypotheses.none()
        self._views: list[KeyView] = []
        self._T_step: Array | None = None
        self._T_look: Array | None = None
        self._way_m = 0.0
        self._since_search = math.inf
        self._searches = 0  # that were complete, since there were not too many places to keep
        self._overview = 0.0  # updates in which all places that explain them have been known
        self._convinced = 0  # updates in a row at which all spoke for one place
        self._crowd = 1.0  # how many places looked alike at the most, counted by their weights
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
        if way < _LOOK_M and turn < _LOOK_RAD:
            return 0.0
        return min(1.0, way / _NEW_WAY_M + turn / _NEW_TURN_RAD)

    def _look(self, scan: Scan, T_odom_base: Array, novelty: float) -> None:
        """One update: move, search if that is due, weigh, drop what does not explain the scan."""
        judge = self._ready(scan)
        seen = observe(scan, self.places.frame.resolution, self.config)
        self._advance(T_odom_base)
        self._since_search += novelty
        every = 1.0 if self._searches < _FIRST_SEARCHES or self._explains_badly() else _LATER_EVERY
        if self._since_search >= every and not self.is_sure:
            self._search(judge, seen, T_odom_base)
        known = self._known
        if len(known):
            known.poses = self._refined(judge, seen)
            judged = judge.explained(known.poses, seen)
            known.take_evidence(judged, len(seen.ranges_m), novelty)
            known.prune()
            self._searches *= not known.are_too_many
            known.resample(None, self.config.samples, self._rng) if not len(known.samples) else None
            logs = judge.log_likelihoods(known.samples, seen)
            known.weigh(logs)
            known.resample(logs, self.config.samples, self._rng)
        if len(known):
            self._crowd = max(self._crowd, float(np.exp(known.log_weights).sum()))
        self._overview = self._overview + novelty if self._searches else 0.0
        self._convinced = self._convinced + 1 if self._speaks_for_one() else 0
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
        return judge.unblocked(poses, seen, known.some_samples(_LOOKED_ALONG))

    def _ready(self, scan: Scan) -> Judge:
        """The judge; the first scan tells which laser it is for."""
        if self._judge is None:
            nodes = calibrate(self.places, scan, self.config, self._rng)
            self._judge = Judge(self.places, self.config, nodes)
            self._usual = usual_share(self.places, self._judge, scan, self.config, self._rng)
        return self._judge

    def _advance(self, T_odom_base: Array) -> None:
        """Move hypotheses and samples with the odometry since the last update."""
        if self._T_look is None:
            return
        motion = se2.between(self._T_look, T_odom_base)
        way = math.hypot(motion[0], motion[1])
        turn = abs(float(motion[2]))
        self._way_m += way
        noise = ODOMETRY_NOISE
        spread = (noise * way + _STANDING_NOISE[0], noise * (way + turn) + _STANDING_NOISE[1])
        self._known.move(motion, spread, self._rng)
        self._drawn = moved(self._drawn, motion)

    def _search(self, judge: Judge, seen: Observation, T_odom_base: Array) -> None:
        """Search for places all over the map that explain this scan and those before it."""
        self._since_search = 0.0
        fresh = max(1, round(_FRESH_SHARE * self.config.samples))
        self._drawn = self._draw(fresh if len(self._known) else self.config.samples)
        logs = judge.log_likelihoods(self._drawn, seen)
        drawn = self._drawn[np.argsort(-logs, kind='stable')[:_FRESH_BEST]]
        found, complete = candidates(self.places, judge, seen, drawn, self._rng)
        if len(found):
            poses = np.concatenate([self._known.poses, found])
            counts, silent = judged_before(judge, self._views, poses, T_odom_base)
            new = slice(len(self._known), None)
            missed = np.zeros(len(poses))
            beams = 0.0
            for k, view in enumerate(self._views):
                missed += missed_beams((counts[k], silent[k]), len(view.seen.ranges_m))
                beams += len(view.seen.ranges_m)
            judged = counts.sum(axis=0)[new], silent.sum(axis=0)[new]
            least = missed[self._known.best()] if len(self._known) else missed.min(initial=np.inf)
            more = missed[new] - least
            self._known.add(found, self._log_prior(), more, judged, beams)
        self._searches += complete
        self._views = [*self._views[-_VIEWS + 1 :], KeyView(seen, T_odom_base)]

    def _log_prior(self) -> float:
        """Log odds of a place that turns up late, against those that are known.

        Less, the better these explain all.
        """
        most = float(self._fits.max(initial=0.0))
        trust = min(max((most - _TRUST_FROM) / (1.0 - _TRUST_FROM), 0.0), 1.0)
        return trust * max(self._searches * _LOG_MISSED, _MIN_LOG_PRIOR)

    def _explains_badly(self) -> bool:
        """Whether no hypothesis explains enough to be sure of."""
        return float(self._fits.max(initial=0.0)) < self.config.min_inlier_ratio

    @property
    def _fits(self) -> Array:
        """Share that each hypothesis explains of what the right place should, (H,)."""
        return np.minimum(self._known.shares_explained / self._usual, 1.0)

    def _draw(self, count: int) -> Array:
        """Samples (N, 3) of all poses at which the robot can stand."""
        places = self.places
        cells = places.standing[self._rng.integers(len(places.standing), size=count)]
        at = places.frame.centres_of(cells.astype(np.int64))
        at += self._rng.uniform(-0.5, 0.5, at.shape) * places.frame.resolution
        return np.column_stack([at, self._rng.uniform(-np.pi, np.pi, count)])

    @property
    def is_sure(self) -> bool:
        """Whether one place alone is left for some updates in a row, and has explained enough.

        Enough of the updates since it turned up: the less it explains, the later it turned up, and
        the more places of this map have looked alike, the more; a place in a map of another
        building may look alike for a while.
        """
        if self._convinced < self.config.accept_updates:
            return False
        best = self._known.best()
        age = float(self._known.ages[best])
        missing = 1.0 - float(self._fits[best])
        rough = 1.0 - self._usual
        varies = min(max(_WORTHLESS_TIMES * rough, _MIN_WORTHLESS), _MAX_WORTHLESS)
        needed = _SURE_UPDATES + _SURE_UPDATES_CROWD * math.log(self._crowd)
        # Bare walls explain the same share everywhere, at wrong places, too: there it takes more of
        # them.
        needed *= _MAX_WORTHLESS / varies
        needed += _SURE_UPDATES_LATE * max(self._overview - age, 0.0)
        return age * (1.0 - missing / (varies + _WORTHLESS_ROUGH * rough)) >= needed

    def _speaks_for_one(self) -> bool:
        known = self._known
        config = self.config
        if not len(known):
            return False
        best = known.best()
        variance = float(np.linalg.eigvalsh(known.covariances[best][:2, :2])[-1])
        sigma_m = math.sqrt(max(variance, 0.0))
        return (
            float(known.weights[best]) >= config.accept_weight
            and float(self._fits[best]) >= config.min_inlier_ratio
            and sigma_m <= _SURE_M
            and math.sqrt(max(float(known.covariances[best][2, 2]), 0.0)) <= _SURE_RAD
        )

    def _lasting(self) -> NDArray[np.bool_]:
        """Hypotheses (H,) that explain enough, and for some time where much has been seen."""
        known = self._known
        enough = self._fits >= self.config.min_inlier_ratio
        if self._overview < _MANY_UPDATES:
            return enough
        least_age = min(_LASTING_SHARE * self._overview, _LASTING_UPDATES)
        return np.asarray(enough & (known.ages >= least_age))

    def _waiting(self, reason: str) -> Result:
        return Result(SearchState.WAITING, reason, ())

    def _result(self, T_odom_base: Array) -> Result:
        known = self._known
        if not len(known):
            return Result(
                SearchState.SEARCHING, 'the scans show too little to tell places apart', ()
            )
        motion = np.zeros(3) if self._T_look is None else se2.between(self._T_look, T_odom_base)
        poses = moved(known.poses, motion)
        weights = known.weights
        shares = known.shares_explained
        order = np.lexsort((-shares, -known.log_weights))
        hypotheses = tuple(
            PoseHypothesis(poses[k], known.covariances[k], float(weights[k]), float(shares[k]))
            for k in order.tolist()
        )
        best = hypotheses[0]
        if self.is_sure:
            reason = f'one place explains {best.explained:.0%} of what was seen'
            return Result(SearchState.LOCALIZED, reason, hypotheses)
        if self._way_m >= self.config.not_in_map_distance_m and not self._lasting().any():
            share = self.config.min_inlier_ratio * self._usual
            reason = f'no place explains {share:.0%} of what was seen for long'
            return Result(SearchState.NOT_IN_MAP, reason, hypotheses)
        likely = int((weights > 0.05 * weights.max()).sum())
        if likely > 1:
            return Result(
                SearchState.AMBIGUOUS, f'{likely} places explain what was seen', hypotheses
            )
        reason = f'one place, not yet sure: {best.explained:.0%} explained'
        return Result(SearchState.SEARCHING, reason, hypotheses)
