"""The places where the robot may be, each with the samples round it and the evidence for it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.places import likelihood
from thinmap_ros.core.places.likelihood import LOG_ODDS_A_BEAM, SILENT_COUNTS, Judge
from thinmap_ros.core.places.place_database import (
    DIRECTIONS,
    RANGE_UNIT_M,
    Observation,
    Places,
    profile,
)
from thinmap_ros.core.places.place_odds import MAX_LOG_RATIO, SURE, MissingShares
from thinmap_ros.core.se2 import BOUND_SIGMAS, Array
from thinmap_ros.jit import kernel

# Standard deviation of odometry per metre and radian: of wheels that slip a little.
ODOMETRY_NOISE = 0.05

# Of the search for candidates.
_MIN_WALLS = 6  # beams that met something, below which a scan could be anywhere
_MAX_SPOTS = 3000
_MIN_SHARE = 0.6  # of the directions that must show what was measured
_BELOW_BEST = 0.2  # share of the beams that a candidate may explain less than the best one


@dataclass(frozen=True, eq=False)
class KeyView:
    """An earlier scan: what it showed, and the odometry pose (3,) at which it was made."""

    seen: Observation
    T_odom_base: Array


def candidates(
    places: Places, judge: Judge, seen: Observation, drawn: Array, rng: np.random.Generator
) -> tuple[Array, bool]:
    """Refined poses (N, 3) that explain a scan about as well as any, and whether these are all.

    The ranges are compared at each position of the map and each heading; the samples drawn (M, 3)
    are added to the best poses. No candidates if the scan has too few hits.
    """
    if int(seen.met.sum()) < _MIN_WALLS:
        return np.empty((0, 3)), False
    spots, complete = _best_spots(places, seen, rng)
    poses = judge.refined(np.concatenate([spots, drawn]), seen)
    counts, silent = judge.explained(poses, seen)
    counts += SILENT_COUNTS * silent
    good = counts >= counts.max() - _BELOW_BEST * len(seen.ranges_m)
    poses = poses[good][np.argsort(-counts[good], kind='stable')]
    found = poses[se2.distinct(poses, _SAME_M, _SAME_RAD, _MAX_HYPOTHESES)]
    return found, complete and len(found) < _MAX_HYPOTHESES


def _best_spots(places: Places, seen: Observation, rng: np.random.Generator) -> tuple[Array, bool]:
    """Poses (N, 3) whose ranges in all directions agree best with a scan; whether these are all."""
    ranges, known, met = profile(seen)
    # Off by half a spacing, by half a direction, and more where walls are seen at a slant.
    slack = places.spacing_m + ranges * (np.pi / DIRECTIONS)
    nearest = np.clip((ranges - slack) / RANGE_UNIT_M, 0.0, 254.0)
    farthest = np.clip((ranges + slack) / RANGE_UNIT_M, 0.0, 255.0)
    low = np.where(known, nearest, 0.0).astype(np.uint8)
    high = np.where(known & met, farthest, 255.0).astype(np.uint8)
    least = DIRECTIONS - round((1.0 - _MIN_SHARE) * int(known.sum()))
    spots, headings, counts = likelihood.spot_scores(places.around, low, high, least)
    # Equals in random order: where there are too many, each has its chance.
    order = np.argsort(-(counts + rng.random(len(counts))), kind='stable')[:_MAX_SPOTS]
    turns = headings[order] * (2.0 * np.pi / DIRECTIONS)
    return np.column_stack([places.spots[spots[order]], turns]), len(counts) <= _MAX_SPOTS


def missed_beams(judged: tuple[Array, Array], beams: int) -> Array:
    """Beams of an update that are not explained, more than by the best one, (N,).

    judged: of so many beams, how many the map explains, and of how many it says nothing, (N,) each.
    """
    missing = beams - judged[0] - SILENT_COUNTS * judged[1]
    return np.asarray(np.minimum(missing - missing.min(initial=np.inf), _MAX_MISSING_BEAMS))


@dataclass(frozen=True, eq=False)
class Look:
    """What one scan says at each of some poses (N).

    missed (N,): beams that are not explained there, more than at the best one, of so many beams;
    found (N,): share that the map shows again, of those of which it tells; log_ratios (N,): against
    any other place.
    """

    missed: Array
    beams: int
    found: Array
    log_ratios: Array


def look_at(model: MissingShares, judge: Judge, poses: Array, seen: Observation) -> Look:
    """The look of a scan at poses (N, 3)."""
    judged = judge.explained(poses, seen)
    beams = len(seen.ranges_m)
    found, known = shares(*judged, beams)
    return Look(missed_beams(judged, beams), beams, found, model.log_ratios(found, known))


def shares(explained: Array, silent: Array, beams: int) -> tuple[Array, Array]:
    """Share of beams that the map explains, of those of which it tells, and of how many it tells.

    explained, silent (N,): of so many beams, those explained, and those of which it says nothing.
    """
    told = beams - silent
    return np.asarray(explained / np.maximum(told, 1.0)), np.asarray(told / beams)


def looks_before(
    judge: Judge,
    model: MissingShares,
    views: Sequence[KeyView],
    poses: Array,
    T_odom_base: Array,
) -> list[Look]:
    """The looks of earlier views at poses (N, 3) held now, the last one first.

    By odometry back to there.
    """
    looks = []
    now = poses
    at = T_odom_base
    for view in reversed(views):
        # From view to view: what odometry is off does not add up.
        back = se2.between(at, view.T_odom_base)
        drifts = np.broadcast_to(_drift(back), (len(now), 3, 3))
        now = judge.refined(se2.compose_each(now, back[None]), view.seen, drifts)
        at = view.T_odom_base
        looks.append(look_at(model, judge, now, view.seen))
    return looks


def _drift(motion: Array) -> Array:
    """Covariance (3, 3) of a motion (3,) by odometry."""
    way = float(np.hypot(motion[0], motion[1]))
    turn = abs(float(motion[2]))
    position_m = ODOMETRY_NOISE * way
    return np.diag(np.square([position_m, position_m, ODOMETRY_NOISE * (way + turn)]))


# Shares of the beams that fall to either side at edges: by chance, and, as the cells of the map
# lie, always.
_EDGE_SHARE = 0.05

_LASTING_SHARE = 0.01

# A single scan may mislead (a person in the way, a door that has moved): its evidence is limited.
_MAX_MISSING_BEAMS = MAX_LOG_RATIO / LOG_ODDS_A_BEAM

_MIN_LOG_WEIGHT = -SURE - MAX_LOG_RATIO

_MAX_HYPOTHESES = 400
_SAME_M = 0.3
_SAME_RAD = 0.15

# Of those this near to each other one is kept: the place may be anywhere between.
_NEW_SIGMA_M = 0.5 * _SAME_M
_NEW_SIGMA_RAD = 0.5 * _SAME_RAD


def allowed_beams(beams: Array) -> Array:
    """How many of so many beams, over all updates, one place may explain more than its double."""
    spread = np.sqrt(beams * _EDGE_SHARE * (1.0 - _EDGE_SHARE))
    return np.asarray(BOUND_SIGMAS * spread + _LASTING_SHARE * beams)


@dataclass(eq=False)
class Hypotheses:
    """Places of the robot as arrays over hypotheses (H); samples (N, 3) and owners (N,), in order.

    poses (H, 3); priors (H,): log odds of each from the beginning; missed, compared (H,): beams
    that it did not explain while the best one did, and of how many; covariances (H, 3, 3);
    evidence (H,): sum of the log likelihood ratios of each against others; found (H,): share of
    the last look that the map shows again there.
    """

    poses: Array
    priors: Array
    missed: Array
    compared: Array
    covariances: Array
    evidence: Array
    found: Array
    samples: Array
    owners: NDArray[np.int64]

    @staticmethod
    def none() -> 'Hypotheses':
        """No hypothesis."""
        none = np.empty(0)
        poses = np.empty((0, 3))
        covariances = np.empty((0, 3, 3))
        owners = np.empty(0, dtype=np.int64)
        return Hypotheses(poses, none, none, none, covariances, none, none, poses, owners)

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def log_weights(self) -> Array:
        """Log odds (H,), the best one 0.

        Differences that chance brings about at edges count for nothing, however often they come:
        two rooms that look the same stay equally likely. What is allowed for chance grows with the
        root of the updates, what a place that is not the right one misses grows with the updates.
        """
        if not len(self):
            return np.empty(0)
        best = int(self.missed.argmin())
        allowed = allowed_beams(np.minimum(self.compared, self.compared[best]))
        beyond = np.maximum(self.missed - self.missed[best] - allowed, 0.0)
        logs = self.priors - LOG_ODDS_A_BEAM * beyond
        return np.asarray(logs - logs.max())

    @property
    def weights(self) -> Array:
        """Probability of each, given that one of them is right, (H,)."""
        odds = np.exp(self.log_weights)
        return np.asarray(odds / max(float(odds.sum()), 1e-300))

    def move(self, motion: Array, noise: tuple[float, float], rng: np.random.Generator) -> None:
        """Move all by odometry (3,), robot frame; samples with noise: 1 sigma, m and rad."""
        self.poses = se2.compose_each(self.poses, motion[None])
        self.samples = se2.compose_each(self.samples, motion[None])
        spread = np.array([noise[0], noise[0], noise[1]])
        self.samples += rng.normal(size=self.samples.shape) * spread
        self.covariances = self.covariances + np.diag(spread**2)

    def take_evidence(self, look: Look, novelty: float, most: float) -> None:
        """Add the evidence of a look at each.

        novelty: its weight, 1 for an independent one; most: evidence beyond which more tells
        nothing.
        """
        self.missed = self.missed + novelty * look.missed
        self.compared = self.compared + novelty * look.beams
        self.evidence = np.minimum(self.evidence + novelty * look.log_ratios, most)
        self.found = look.found

    def add(self, poses: Array, prior: float, looks: Sequence[Look], most: float) -> None:
        """Add new hypotheses (N, 3), but for those at a known one for which much more speaks.

        prior: log odds, of places that turn up as late; looks: earlier ones, at the existing
        hypotheses and at these; most: as in `take_evidence`.
        """
        old = len(self)
        count = len(poses)
        every = np.zeros(old + count)
        missed = every + sum((look.missed for look in looks), every)
        base = 0.0
        if old:
            best = self.best()
            base = float(self.missed[best] - missed[best])
        evidence = every + prior
        for look in looks:
            evidence = np.minimum(evidence + look.log_ratios, most)
        covariance = np.diag([_NEW_SIGMA_M**2, _NEW_SIGMA_M**2, _NEW_SIGMA_RAD**2])
        fresh = np.broadcast_to(covariance, (count, 3, 3))
        is_new = ~self._are_known(poses, evidence[old:])
        for name, values in (
            ('poses', poses),
            ('priors', np.full(count, prior)),
            ('missed', base + missed[old:]),
            ('compared', np.full(count, float(sum(look.beams for look in looks)))),
            ('covariances', fresh),
            ('evidence', evidence[old:]),
            ('found', looks[0].found[old:] if looks else every[old:]),
        ):
            setattr(self, name, np.concatenate([getattr(self, name), values[is_new]]))

    def _are_known(self, poses: Array, evidence: Array) -> NDArray[np.bool_]:
        """Whether at poses (N, 3) with evidence (N,) there is one for which much more speaks, (N,).

        Much: more than one look may tell. Odometry leads back from it to where it misses beams that
        it explained, and by them a new one at the same place would seem better.
        """
        off = np.abs(poses[:, None] - self.poses)
        near = (off[..., :2] <= _SAME_M).all(axis=2) & (np.abs(se2.wrap(off[..., 2])) <= _SAME_RAD)
        is_more = self.evidence > evidence[:, None] + MAX_LOG_RATIO
        return np.asarray((near & is_more).any(axis=1))

    def prune(self) -> None:
        """Drop what is out of the question, and of what has come together all but the likeliest."""
        logs = self.log_weights
        order = self.order()
        order = order[logs[order] > _MIN_LOG_WEIGHT]
        kept = order[se2.distinct(self.poses[order], _SAME_M, _SAME_RAD, _MAX_HYPOTHESES)]
        if len(kept) == len(self) == int(self.owners.max(initial=-1)) + 1:
            return
        renumbered = np.full(len(self.poses), -1)
        renumbered[kept] = np.arange(len(kept))
        for name in ('poses', 'priors', 'missed', 'compared', 'covariances', 'evidence', 'found'):
            setattr(self, name, getattr(self, name)[kept])
        owners = renumbered[self.owners]
        order = np.argsort(owners, kind='stable')[int((owners < 0).sum()) :]
        self.samples = self.samples[order]
        self.owners = owners[order]

    def some_samples(self, total: int) -> Array:
        """Some of the samples of each, as many for all: (H, K, 3).

        Those of one without any are its pose.
        """
        count = max(1, total // len(self))
        bounds = np.searchsorted(self.owners, np.arange(len(self) + 1))
        sizes = np.diff(bounds)
        picks = bounds[:-1, None] + np.arange(count) * sizes[:, None] // count
        some = self.samples[np.minimum(picks, len(self.samples) - 1)]
        return np.where(sizes[:, None, None] > 0, some, self.poses[:, None])

    def best_samples(self, log_likelihoods: Array) -> Array:
        """Of the samples of each, the one with the highest log likelihood (N,).

        Its pose where it has none: (H, 3).
        """
        best = self.poses.copy()
        order = np.lexsort((log_likelihoods, self.owners))
        last = np.flatnonzero(np.diff(self.owners, append=-1))
        best[self.owners[last]] = self.samples[order[last]]
        return best

    def weigh(self, log_likelihoods: Array) -> None:
        """Mean and covariance of the samples of each, weighted by their log likelihoods (N,)."""
        bounds = np.searchsorted(self.owners, np.arange(len(self) + 1))
        _moments(self.samples, log_likelihoods, bounds, self.poses, self.covariances)

    def resample(self, log_likelihoods: Array | None, total: int, rng: np.random.Generator) -> None:
        """As many samples for each, drawn from its own by weight.

        New ones get theirs from their covariance.
        """
        count = len(self)
        if not count:
            return
        quotas = np.full(count, total // count)
        quotas[: total - int(quotas.sum())] += 1
        bounds = np.searchsorted(self.owners, np.arange(count + 1))
        if log_likelihoods is None:
            log_likelihoods = np.zeros(len(self.samples))
        spreads = np.asarray(np.linalg.cholesky(self.covariances + np.diag([1e-8, 1e-8, 1e-8])))
        self.samples = _resampled(
            self.samples,
            log_likelihoods,
            bounds,
            quotas,
            self.poses,
            spreads,
            rng.random(count),
            rng.normal(size=(total, 3)),
        )
        self.owners = np.repeat(np.arange(count), quotas)

    def is_narrow(self, number: int) -> bool:
        """Whether a hypothesis is not wider than one place."""
        covariance = self.covariances[number]
        is_near = se2.sigma_m(covariance) <= _NEW_SIGMA_M
        return is_near and float(covariance[2, 2]) <= _NEW_SIGMA_RAD**2

    def best(self) -> int:
        """Number of the likeliest one."""
        return int(self.order()[0])

    def order(self) -> NDArray[np.int64]:
        """Numbers (H,), the likeliest first; of equals that with most evidence."""
        return np.lexsort((-self.evidence, -self.log_weights))


@kernel
def _moments(
    samples: Array, logs: Array, bounds: NDArray[np.int64], poses: Array, covariances: Array
) -> None:
    """Covariances (H, 3, 3) of weighted samples about their mean.

    Those without samples keep theirs.
    """
    for h in range(len(poses)):
        low = bounds[h]
        high = bounds[h + 1]
        if low == high:
            continue
        top = logs[low:high].max()
        total = 0.0
        squares = 0.0
        mean = np.zeros(3)
        second = np.zeros((3, 3))
        for k in range(low, high):
            weight = math.exp(logs[k] - top)
            turn = math.pi - (math.pi - (samples[k, 2] - poses[h, 2])) % (2.0 * math.pi)
            off = np.array([samples[k, 0] - poses[h, 0], samples[k, 1] - poses[h, 1], turn])
            total = total + weight
            squares = squares + weight * weight
            for i in range(3):
                mean[i] += weight * off[i]
                for j in range(3):
                    second[i, j] += weight * off[i] * off[j]
        for i in range(3):
            for j in range(3):
                covariances[h, i, j] = second[i, j] / total - mean[i] * mean[j] / total**2


@kernel
def _resampled(
    samples: Array,
    logs: Array,
    bounds: NDArray[np.int64],
    quotas: NDArray[np.int64],
    poses: Array,
    spreads: Array,
    starts: Array,
    normal: Array,
) -> Array:
    """Samples drawn by weight within each group, a comb for each.

    Groups without any are drawn round their poses.
    spreads (H, 3, 3): lower triangular; starts (H,): in [0, 1); normal (N, 3): standard normal
    numbers.
    """
    result = np.empty((quotas.sum(), 3))
    at = 0
    for h in range(len(poses)):
        low = bounds[h]
        high = bounds[h + 1]
        if low == high:
            for _ in range(quotas[h]):
                for i in range(3):
                    result[at, i] = poses[h, i]
                    for j in range(i + 1):
                        result[at, i] += spreads[h, i, j] * normal[at, j]
                at += 1
            continue
        top = logs[low:high].max()
        total = 0.0
        for k in range(low, high):
            total += math.exp(logs[k] - top)
        k = low
        sum_so_far = math.exp(logs[low] - top)
        for n in range(quotas[h]):
            mark = (n + starts[h]) / quotas[h] * total
            while sum_so_far < mark and k < high - 1:
                k += 1
                sum_so_far += math.exp(logs[k] - top)
            result[at] = samples[k]
            at += 1
    return result
