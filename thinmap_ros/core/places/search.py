"""An update at all of the map for places where the last few scans could have been made."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.places import likelihood
from thinmap_ros.core.places.likelihood import SILENT_COUNTS, Judge
from thinmap_ros.core.places.place_database import (
    DIRECTIONS,
    RANGE_UNIT_M,
    Observation,
    Places,
    profile,
)
from thinmap_ros.core.se2 import Array

# Standard deviation of odometry per metre and radian: of wheels that slip a little.
ODOMETRY_NOISE = 0.05
_MIN_WALLS = 6  # beams that met something, below which a scan could be anywhere
_MAX_SPOTS = 3000
_MAX_REFINED = 600
_MIN_SHARE = 0.6  # of the directions that must show what was measured
_CLEARLY_WORSE = 0.1  # share of the directions
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
    poses = poses[good]
    counts = counts[good]
    found = distinct(poses[np.argsort(-counts, kind='stable')], 0.3, 0.15, _MAX_REFINED)
    return found, complete and len(found) < _MAX_REFINED


def _best_spots(places: Places, seen: Observation, rng: np.random.Generator) -> tuple[Array, bool]:
    """Poses (N, 3) whose ranges in all directions agree best with a scan.

    Also whether no candidate is missing.
    """
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
    # Those left out must be clearly worse than the best.
    margin = _CLEARLY_WORSE * int(known.sum())
    cut = len(counts) > _MAX_SPOTS and counts[order[-1]] > counts.max() - margin
    return np.column_stack([places.spots[spots[order]], turns]), not cut


def distinct(poses: Array, apart_m: float, apart_rad: float, most: int) -> Array:
    """The first of each group of poses (N, 3) that lie near each other, at most so many."""
    return poses[distinct_indices(poses, apart_m, apart_rad, most)]


def distinct_indices(poses: Array, apart_m: float, apart_rad: float, most: int) -> list[int]:
    """Indices of the first of each group of poses (N, 3) near each other, at most so many."""
    kept: list[int] = []
    at = np.empty((most, 3))
    for k, T in enumerate(poses):
        others = at[: len(kept)]
        near = (np.abs(others[:, 0] - T[0]) < apart_m) & (np.abs(others[:, 1] - T[1]) < apart_m)
        turned = np.abs(se2.wrap(others[near, 2] - T[2]))
        if not (turned < apart_rad).any():
            at[len(kept)] = T
            kept.append(k)
            if len(kept) == most:
                break
    return kept


def judged_before(
    judge: Judge,
    views: list[KeyView],
    poses: Array,
    T_odom_base: Array,
) -> tuple[Array, Array]:
    """How many beams of earlier views (V) the map explains from poses (N, 3) held now.

    Also of how many it says nothing; (V, N) each, by odometry back to there.
    """
    counts = np.zeros((len(views), len(poses)))
    silent = np.zeros((len(views), len(poses)))
    now = poses
    at = T_odom_base
    for k in range(len(views) - 1, -1, -1):
        view = views[k]
        # From view to view: what odometry is off does not add up.
        back = se2.between(at, view.T_odom_base)
        drift = _drift(back)
        now = judge.refined(moved(now, back), view.seen, np.broadcast_to(drift, (len(now), 3, 3)))
        at = view.T_odom_base
        counts[k], silent[k] = judge.explained(now, view.seen)
    return counts, silent


def _drift(motion: Array) -> Array:
    """Covariance (3, 3) of a motion (3,) by odometry."""
    way = float(np.hypot(motion[0], motion[1]))
    turn = abs(float(motion[2]))
    position_m = ODOMETRY_NOISE * way
    return np.diag(np.square([position_m, position_m, ODOMETRY_NOISE * (way + turn)]))


def moved(poses: Array, motion: Array) -> Array:
    """Poses (N, 3) after a motion (3,) in the robot frame."""
    c = np.cos(poses[:, 2])
    s = np.sin(poses[:, 2])
    x = poses[:, 0] + c * motion[0] - s * motion[1]
    y = poses[:, 1] + s * motion[0] + c * motion[1]
    return np.column_stack([x, y, se2.wrap(poses[:, 2] + motion[2])])
