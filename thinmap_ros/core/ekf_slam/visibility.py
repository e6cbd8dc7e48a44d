"""Detection of removed features, such as an opened door, by beams that pass through them."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.ekf_slam.features import FeatureTrack, normals_of, tangents_of
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, compose

_BEYOND_M = 0.3  # a beam that ends this far behind a feature has passed through it
_END_M = 0.15  # margin at the ends of a feature where beams are ignored
_MIN_BEAMS = 8
_SHARE = 0.7  # smallest share of passing beams among those that reach the feature
_FLATTEST = 0.17  # smallest sine of the angle between beam and wall


def seen_through(
    scan: Scan, T_map_base: Array, lines: Array, features: list[FeatureTrack]
) -> NDArray[np.bool_]:
    """Whether the scan passes through each feature with its line (N, 2), map frame; (N,).

    Most of the beams that should hit the feature, and enough of them, end well behind it. Beams
    without return are ignored: glass and black walls cause them, too.
    """
    if not features:
        return np.zeros(0, dtype=np.bool_)
    T_map_laser = compose(T_map_base, scan.T_base_laser)
    angles = scan.angles_rad[scan.hit] + T_map_laser[2]
    beams = np.column_stack([np.cos(angles), np.sin(angles)])
    towards = beams @ normals_of(lines).T
    with np.errstate(divide='ignore', invalid='ignore'):
        expected = (lines[:, 0] - normals_of(lines) @ T_map_laser[:2]) / towards
        along = tangents_of(lines) @ T_map_laser[:2] + expected * (beams @ tangents_of(lines).T)
    low, high = np.array([(f.low, f.high) for f in features]).T
    aimed = (
        (expected > 0.0)
        & (np.abs(towards) > _FLATTEST)
        & (along > low + _END_M)
        & (along < high - _END_M)
    )
    ranges = scan.ranges_m[scan.hit][:, None]
    through = (aimed & (ranges > expected + _BEYOND_M)).sum(axis=0)
    reaching = (aimed & (ranges > expected - _BEYOND_M)).sum(axis=0)
    return np.asarray((through >= _MIN_BEAMS) & (through > _SHARE * reaching))
