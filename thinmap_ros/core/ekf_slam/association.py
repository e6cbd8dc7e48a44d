"""Which line of the scan is which feature of the map.

Source: EKF-SLAM/TI paper eq. (13), with the sign of the gate as it must be: v' S^-1 v <= 5.99, two
degrees of freedom, 95 %. Infinite lines agree where walls of different rooms are collinear, so what
was seen of them has to meet as well; and the two faces of a thin wall are two features, each seen
from its own side. Lines that could be several features are decided after the others have corrected
the pose, so that the scan is taken as a whole (the idea of Neira and Tardos, "Data association in
stochastic mapping using the joint compatibility test", 2001).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.ekf_slam.ekf import EkfSlam
from thinmap_ros.core.ekf_slam.features import FeatureTrack, normals_of, sides_of, tangents_of
from thinmap_ros.core.ekf_slam.line_extraction import Lines
from thinmap_ros.core.se2 import Array, transform_points, wrap

# Only pairs nearer than this are put to the statistical test at all.
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
    """For each line of a scan the index of the feature it fits best, and whether others fit, too.

    Both (K,); index: -1 where there is none.
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
    """Which features the lines of a scan are, each taken by itself.

    laser_map (2,): where the scan was seen from. Lines that could be several features are better
    asked again when the others have corrected the pose.
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
    """Which segments, by their ends (K, 2, 2), could be part of which features, (K, N).

    Direction and offset roughly agree, the intervals along the line lie at most gap_m apart, and
    the place (2,) from which the segments were seen is on the feature's side.
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
    """Squared Mahalanobis distance v' S^-1 v of a (2,) and a (2, 2).

    Inf where S is not positive.
    """
    determinant = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    if not (determinant > 0.0 and S[0, 0] > 0.0):
        return math.inf
    squares = v[0] * v[0] * S[1, 1] + v[1] * v[1] * S[0, 0] - v[0] * v[1] * (S[0, 1] + S[1, 0])
    return float(squares / determinant)
