"""The line features of the map and their care: how one enters, grows, and is found to be another one.

Source: EKF-SLAM/TI paper section 2; the paper does not say when a feature enters, so that is ours: after several
sightings from different places, because a feature that was only clutter would stay in the state for ever.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.config import parameter
from thinmap_ros.core.se2 import Array, transform_points
from thinmap_ros.core.slam.association import AssociationConfig, associate, mahalanobis, meeting
from thinmap_ros.core.slam.ekf import EkfSlam, line_difference
from thinmap_ros.core.slam.features import Feature, LineFeature, as_seen, interval, point_on
from thinmap_ros.core.slam.lines import Lines
from thinmap_ros.core.slam.models import place_line


@dataclass(frozen=True)
class FeatureConfig(AssociationConfig):
    """Parameters of the upkeep of features."""

    wall_sigma_m: float = parameter(0.02, 'how far real walls are from straight lines, 1 sigma, m', low=0.0, high=1.0)
    wall_sigma_rad: float = parameter(0.006, 'how far real walls are from straight lines, rad', low=0.0, high=0.5)
    sightings: int = parameter(4, 'a line enters the map after so many sightings', low=1, high=100)
    patience: int = parameter(15, 'a candidate not seen for so many looks is dropped', low=1, high=10_000)


@dataclass(eq=False)
class _Candidate:
    """A line seen that is no feature yet: line (r, alpha) and interval as seen last, in the map."""

    line: Array
    span: Feature
    sightings: int
    last_look: int


class FeatureMap:
    """The features beside the filter's state, in the same order, and the candidates that may become features."""

    def __init__(self, config: FeatureConfig) -> None:
        self._config = config
        self._wall = np.diag(np.square([config.wall_sigma_m, config.wall_sigma_rad]))
        self._features: list[Feature] = []
        self._candidates: list[_Candidate] = []
        self._looks = 0
        self._next_id = 1

    def __len__(self) -> int:
        return len(self._features)

    def listed(self, ekf: EkfSlam) -> list[LineFeature]:
        """The features as others see them."""
        covariances = ekf.line_covariances()
        return [
            as_seen(feature, ekf.lines[i].copy(), covariances[i]) for i, feature in enumerate(self._features)
        ]

    def observe(self, ekf: EkfSlam, lines: Lines, laser_map: Array) -> tuple[int, bool]:
        """Associate and correct the filter by the lines of a scan seen from a place (2,), then look after the features.

        Returns how many were matched, and whether the filter took the update.
        """
        self._looks += 1
        lines = Lines(lines.z, lines.covariances + self._wall, lines.ends)
        chosen = associate(ekf, self._features, lines, laser_map, self._config)
        matched, unknown = np.flatnonzero(chosen >= 0), np.flatnonzero(chosen < 0)
        taken = ekf.update(chosen[matched], lines.z[matched], lines.covariances[matched])
        self._grow(ekf, chosen[matched], lines.chosen(matched))
        self._merge(ekf, chosen[matched])
        self._take_up(ekf, lines.chosen(unknown), laser_map)
        return len(matched), taken

    def _grow(self, ekf: EkfSlam, indices: NDArray[np.int64], lines: Lines) -> None:
        """Features become as long as what was seen of them."""
        for index, ends in zip(indices, lines.ends, strict=True):
            feature = self._features[index]
            low, high = interval(ekf.lines[index], transform_points(ekf.pose, ends))
            feature.low, feature.high = min(feature.low, low), max(feature.high, high)

    def _merge(self, ekf: EkfSlam, indices: NDArray[np.int64]) -> None:
        """Of the features just seen, those that turn out to be another one are tied to it in the filter and go."""
        for feature in [self._features[i] for i in np.unique(indices)]:
            if feature in self._features:
                kept = self._features.index(feature)
                twin = self._twin(ekf, kept)
                if twin is not None and ekf.tie(min(kept, twin), max(kept, twin), self._wall):
                    self._unite(ekf, min(kept, twin), max(kept, twin))

    def _twin(self, ekf: EkfSlam, index: int) -> int | None:
        """Another feature that passes for the same wall: it meets this one, and their difference passes the gate."""
        ends = self._ends(ekf, index)
        near = meeting(ekf.lines, self._features, ends[None], self._features[index].seen_from, 0.0)[0]
        for other in np.flatnonzero(near):
            if other != index and self._is_one_wall(ekf, index, int(other)):
                return int(other)
        return None

    def _is_one_wall(self, ekf: EkfSlam, a: int, b: int) -> bool:
        v, S, _ = ekf.difference(a, b)
        apart = np.abs(self._ends(ekf, b) @ (np.cos(ekf.lines[a, 1]), np.sin(ekf.lines[a, 1])) - ekf.lines[a, 0])
        close = apart.max() <= 3.0 * self._config.wall_sigma_m
        return bool(close) and mahalanobis(v, S + self._wall) <= self._config.gate

    def _ends(self, ekf: EkfSlam, index: int) -> Array:
        return _ends_of(self._features[index], ekf.lines[index])

    def _unite(self, ekf: EkfSlam, kept: int, dropped: int) -> None:
        feature = self._features[kept]
        low, high = interval(ekf.lines[kept], self._ends(ekf, dropped))
        feature.low, feature.high = min(feature.low, low), max(feature.high, high)
        ekf.remove(dropped)
        del self._features[dropped]

    def _take_up(self, ekf: EkfSlam, lines: Lines, laser_map: Array) -> None:
        """Lines seen often enough at the same place become features."""
        for z, covariance, ends in zip(lines.z, lines.covariances, lines.ends, strict=True):
            candidate = self._candidate(ekf.pose, z, covariance, transform_points(ekf.pose, ends), laser_map)
            if candidate.sightings < self._config.sightings:
                continue
            self._candidates.remove(candidate)
            if not self._is_known(ekf, candidate):
                index = ekf.add(z, covariance)
                span = interval(ekf.lines[index], _ends_of(candidate.span, candidate.line))
                self._features.append(Feature(self._next_id, *span, candidate.span.seen_from))
                self._next_id += 1
        oldest = self._looks - self._config.patience
        self._candidates = [c for c in self._candidates if c.last_look >= oldest]

    def _candidate(self, pose: Array, z: Array, covariance: Array, ends_map: Array, laser_map: Array) -> _Candidate:
        """The candidate that a seen line continues, brought up to date, or a new one."""
        line, _, by_seen = place_line(pose, z)
        if self._candidates:
            placed = np.array([c.line for c in self._candidates])
            spans = [c.span for c in self._candidates]
            near = meeting(placed, spans, ends_map[None], laser_map, self._config.gap_m)[0]
            # Two looks at one line differ by the noise of both; the robot hardly moved in between.
            S = 2.0 * by_seen @ covariance @ by_seen.T
            for index in np.flatnonzero(near):
                candidate = self._candidates[index]
                v, signs = line_difference(line, candidate.line)
                if mahalanobis(v, S) <= self._config.gate:
                    return self._seen_again(candidate, v + signs * candidate.line, ends_map)
        span = Feature(0, *interval(line, ends_map), laser_map)
        self._candidates.append(_Candidate(line, span, 1, self._looks))
        return self._candidates[-1]

    def _seen_again(self, candidate: _Candidate, line: Array, ends_map: Array) -> _Candidate:
        low, high = interval(line, ends_map)
        candidate.span.low, candidate.span.high = min(candidate.span.low, low), max(candidate.span.high, high)
        candidate.line, candidate.last_look = line, self._looks
        candidate.sightings += 1
        return candidate

    def _is_known(self, ekf: EkfSlam, candidate: _Candidate) -> bool:
        """Whether a feature covers the candidate's place, though it failed the gate: two for one wall help nobody."""
        if not self._features:
            return False
        span = candidate.span
        start, end = _ends_of(span, candidate.line)
        middle, reach = 0.5 * (start + end), 0.25 * (end - start)
        ends = np.stack([middle - reach, middle + reach])
        near = meeting(ekf.lines, self._features, ends[None], span.seen_from, 0.0)[0]
        normals = np.column_stack([np.cos(ekf.lines[:, 1]), np.sin(ekf.lines[:, 1])])
        return bool(np.any(near & (np.abs(normals @ middle - ekf.lines[:, 0]) <= 3.0 * self._config.wall_sigma_m)))


def _ends_of(feature: Feature, line: Array) -> Array:
    """Ends (2, 2) of a feature on its line (r, alpha), map frame."""
    return np.stack([point_on(line, feature.low), point_on(line, feature.high)])
