"""Data association: nearest neighbour of each line of a scan among the features.

Source: EKF-SLAM/TI paper eq. (13), with the sign of the gate corrected: v' S^-1 v <= 5.99, two
degrees of freedom, 95 %. Collinear walls of different rooms are on one infinite line, so the
observed segments have to overlap or be near, too. The two faces of a thin wall are two features,
each observed from its own side. Ambiguous lines are associated after the others have updated the
pose, so that the scan is considered jointly (the idea of Neira and Tardos, "Data association in
stochastic mapping using the joint compatibility test", 2001).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.ekf_slam.ekf import EkfSlam
from thinmap_ros.core.ekf_slam.features import (
    FeatureTrack,
    Lines,
    normals_of,
    sides_of,
    tangents_of,
)
from thinmap_ros.core.se2 import Array, transform_points, wrap

# Only pairs nearer than this are tested by their Mahalanobis distance.
_NEAR_M = 0.5
_NEAR_RAD = math.radians(15.0)


@dataclass(frozen=True)
class AssociationConfig(Config):
    """Parameters of data association."""

    gate: float = parameter(
        5.99,
        'Largest squared Mahalanobis distance between a line and a feature (2 degrees of freedom: '
        '95 %). Raise it if features double, lower it if different walls are merged.',
        low=0.1,
        high=50.0,
    )
    max_gap_m: float = parameter(
        3.0,
        'Largest gap along the line between an observed segment and the feature that it extends '
        '(m); at least the width of a door. Lower it if collinear walls of different rooms merge.',
        low=0.0,
        high=20.0,
    )


@dataclass(frozen=True, eq=False)
class Associations:
    """Nearest feature of each line of a scan, and whether several features pass the gate.

    Both (K,); index: -1 if no feature passes the gate.
    """

    index: NDArray[np.int64]
    ambiguous: NDArray[np.bool_]


def associate(
    ekf: EkfSlam,
    features: list[FeatureTrack],
    lines: Lines,
    laser_map: Array,
    config: AssociationConfig,
) -> Associations:
    """Associate each line of a scan with its nearest feature, independently of other lines.

    laser_map (2,): position of the laser, map frame. Ambiguous lines should be associated again
    after the others have updated the pose.
    """
    chosen = np.full(len(lines), -1, dtype=np.int64)
    passing = np.zeros(len(lines), dtype=np.int64)
    if not features:
        return Associations(chosen, passing > 1)
    ends_map = transform_points(ekf.pose, lines.ends.reshape(-1, 2)).reshape(-1, 2, 2)
    pairs = np.argwhere(meeting(ekf.lines, features, ends_map, laser_map, config.max_gap_m))
    best = np.full(len(lines), np.inf)
    for k, index in pairs:
        expected, spread, _ = ekf.innovations(int(index))
        v = lines.z[k] - expected
        v[1] = wrap(float(v[1]))
        distance = mahalanobis(v, spread + lines.covariances[k])
        if distance > config.gate:
            continue
        passing[k] += 1
        if distance <= best[k]:
            best[k] = distance
            chosen[k] = index
    return Associations(chosen, passing > 1)


def meeting(
    lines_map: Array, features: list[FeatureTrack], ends_map: Array, seen_from: Array, gap_m: float
) -> NDArray[np.bool_]:
    """Whether segments with ends (K, 2, 2), map frame, may be part of features, (K, N).

    Direction and offset agree roughly, the intervals along the line are at most gap_m apart, and
    the laser, at seen_from (2,), is on the side from which the feature was first observed.
    """
    offsets = np.abs(ends_map.mean(axis=1) @ normals_of(lines_map).T - lines_map[:, 0])
    chords = ends_map[:, 1] - ends_map[:, 0]
    rise = np.abs(chords @ normals_of(lines_map).T) / np.maximum(np.hypot(*chords.T), 1e-9)[:, None]
    along = ends_map @ tangents_of(lines_map).T
    low = np.array([f.low for f in features])
    high = np.array([f.high for f in features])
    gaps = np.maximum(low - along.max(axis=1), along.min(axis=1) - high)
    first_seen_from = np.array([f.first_seen_from for f in features]).reshape(-1, 2)
    facing = sides_of(lines_map, seen_from) == sides_of(lines_map, first_seen_from)
    return np.asarray(
        (offsets <= _NEAR_M) & (rise <= math.sin(_NEAR_RAD)) & (gaps <= gap_m) & facing
    )


def mahalanobis(v: Array, S: Array) -> float:
    """Squared Mahalanobis distance v' S^-1 v, v (2,), S (2, 2).

    Infinite if S is not positive definite.
    """
    determinant = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    if not (determinant > 0.0 and S[0, 0] > 0.0):
        return math.inf
    squares = v[0] * v[0] * S[1, 1] + v[1] * v[1] * S[0, 0] - v[0] * v[1] * (S[0, 1] + S[1, 0])
    return float(squares / determinant)
