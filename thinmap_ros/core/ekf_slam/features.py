"""Data of line features besides the filter state, and geometry along their lines."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.se2 import Array, wrap


@dataclass(eq=False)
class FeatureTrack:
    """A feature's id, and the observed interval [low, high] (m) of its line.

    Positions along a line are relative to the foot of the perpendicular from the map's origin,
    positive to the left of the normal. first_seen_from (2,): position of the laser at the first
    observation, map frame, m. misses: number of consecutive scans that saw through the feature.
    """

    id: int
    low: float
    high: float
    first_seen_from: Array
    misses: int = 0

    def grow(self, low: float, high: float) -> None:
        """Extend the interval to include another one, m."""
        self.low = min(self.low, low)
        self.high = max(self.high, high)


@dataclass(frozen=True, eq=False)
class LineFeature:
    """A feature for display and storage.

    r_m >= 0 and alpha_rad with their covariance (2, 2); start, end (2,): m, map frame; nodes: ids
    of the topological nodes at which it is stored; local: whether it is in the local area.
    """

    id: int
    r_m: float
    alpha_rad: float
    covariance: Array
    start: Array
    end: Array
    nodes: list[int]
    local: bool


def normals_of(lines: Array) -> Array:
    """Unit normals (N, 2) of lines (N, 2) as (r, alpha)."""
    return _paired(np.cos(lines[:, 1]), np.sin(lines[:, 1]))


def tangents_of(lines: Array) -> Array:
    """Unit tangents (N, 2) of lines (N, 2): their normals rotated by 90 degrees to the left."""
    return _paired(-np.sin(lines[:, 1]), np.cos(lines[:, 1]))


def _paired(x: Array, y: Array) -> Array:
    """(N, 2) of x (N,) and y (N,); np.column_stack is too slow for such frequent calls."""
    pairs = np.empty((x.size, 2))
    pairs[:, 0] = x
    pairs[:, 1] = y
    return pairs


def sides_of(lines: Array, points: Array) -> Array:
    """Side (N,) of lines (N, 2) on which points (N, 2), or one point (2,), are.

    1: the side of the origin; -1: the other side.
    """
    return np.where(lines[:, 0] - (normals_of(lines) * points).sum(axis=1) >= 0.0, 1.0, -1.0)


def interval(line: Array, points: Array) -> tuple[float, float]:
    """Lowest and highest position of points (M, 2) along a line (r, alpha), m."""
    along = points @ tangents_of(line[None])[0]
    return float(along.min()), float(along.max())


def point_on(line: Array, position: float) -> Array:
    """Point (2,) at a position (m) along a line (r, alpha)."""
    return np.asarray(line[0] * normals_of(line[None])[0] + position * tangents_of(line[None])[0])


def ends_of(feature: FeatureTrack, line: Array) -> Array:
    """Ends (2, 2) of a feature on its line (r, alpha), map frame."""
    return np.stack([point_on(line, feature.low), point_on(line, feature.high)])


def as_seen(
    feature: FeatureTrack, line: Array, covariance: Array, nodes: list[int], local: bool
) -> LineFeature:
    """LineFeature of a feature with its current line (r, alpha), converted to r >= 0."""
    start, end = ends_of(feature, line)
    if line[0] < 0.0:
        signs = np.array([-1.0, 1.0])
        line = np.array([-line[0], line[1] + np.pi])
        covariance = signs[:, None] * covariance * signs
    return LineFeature(
        feature.id, float(line[0]), wrap(float(line[1])), covariance, start, end, nodes, local
    )
