"""What is kept of a line feature beside the filter's state, and where it lies along its line."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.se2 import Array, wrap


@dataclass(eq=False)
class FeatureTrack:
    """A feature's id, the interval [low, high] (m) seen of its line, and from where at first.

    Positions along a line are counted from the foot of the perpendicular from the map's origin, to
    its left. seen_from (2,): in the map frame, m. missed counts the looks in a row that should have
    met the feature and did not.
    """

    id: int
    low: float
    high: float
    first_seen_from: Array
    misses: int = 0

    def grow(self, low: float, high: float) -> None:
        """Become as long as to hold another interval of the line, m."""
        self.low = min(self.low, low)
        self.high = max(self.high, high)


@dataclass(frozen=True, eq=False)
class LineFeature:
    """A feature as others see it.

    id; r >= 0 and alpha with their covariance (2, 2); its ends (2,) each, m, map frame; nodes: ids
    of the topological nodes at which it is stored; local: whether it is in the local area now.
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
    """Directions (N, 2) in which positions along lines (N, 2) grow.

    Their normals turned to the left.
    """
    return _paired(-np.sin(lines[:, 1]), np.cos(lines[:, 1]))


def _paired(x: Array, y: Array) -> Array:
    """(N, 2) of x (N,) and y (N,): asked for so often that np.column_stack would be felt."""
    pairs = np.empty((x.size, 2))
    pairs[:, 0] = x
    pairs[:, 1] = y
    return pairs


def sides_of(lines: Array, points: Array) -> Array:
    """Side of each line (N, 2) on which its point (N, 2), or one point (2,), lies.

    1 the origin's, -1 beyond.
    """
    return np.where(lines[:, 0] - (normals_of(lines) * points).sum(axis=1) >= 0.0, 1.0, -1.0)


def interval(line: Array, points: Array) -> tuple[float, float]:
    """Where along a line (r, alpha) points (M, 2) lie: lowest and highest position."""
    along = points @ tangents_of(line[None])[0]
    return float(along.min()), float(along.max())


def point_on(line: Array, position: float) -> Array:
    """Point (2,) at a position along a line (r, alpha)."""
    return np.asarray(line[0] * normals_of(line[None])[0] + position * tangents_of(line[None])[0])


def ends_of(feature: FeatureTrack, line: Array) -> Array:
    """Ends (2, 2) of a feature on its line (r, alpha), map frame."""
    return np.stack([point_on(line, feature.low), point_on(line, feature.high)])


def as_seen(
    feature: FeatureTrack, line: Array, covariance: Array, nodes: list[int], local: bool
) -> LineFeature:
    """The feature with its line (r, alpha) of the present state, for others: with r >= 0."""
    start, end = ends_of(feature, line)
    if line[0] < 0.0:
        signs = np.array([-1.0, 1.0])
        line = np.array([-line[0], line[1] + np.pi])
        covariance = signs[:, None] * covariance * signs
    return LineFeature(
        feature.id, float(line[0]), wrap(float(line[1])), covariance, start, end, nodes, local
    )
