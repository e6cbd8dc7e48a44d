"""Feature candidates: a line becomes a feature after several observations at one place."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.ekf_slam.association import mahalanobis, meeting
from thinmap_ros.core.ekf_slam.ekf import line_difference
from thinmap_ros.core.ekf_slam.features import FeatureTrack, Lines, interval, place_line
from thinmap_ros.core.se2 import Array, transform_points


@dataclass(eq=False)
class FeatureCandidate:
    """A line (r, alpha), map frame, and its observed interval.

    z (2,) with covariance (2, 2): the last observation, robot frame.
    """

    line: Array
    span: FeatureTrack
    z: Array
    covariance: Array
    observations: int
    last_observed: int


class FeatureCandidates:
    """The lines with too few observations to be features."""

    def __init__(self, min_observations: int, max_misses: int, gate: float, gap_m: float) -> None:
        """Create an empty set.

        min_observations: number after which a line becomes a feature; max_misses: observations
        without a match after which a candidate is dropped; gate, gap_m: as in `associate`.
        """
        self._min_observations = min_observations
        self._max_misses = max_misses
        self._gate = gate
        self._gap_m = gap_m
        self._all: list[FeatureCandidate] = []
        self._observations = 0

    def update(self, pose: Array, lines: Lines, laser_map: Array) -> list[FeatureCandidate]:
        """Update by the lines of a scan at a pose (3,), with the laser at laser_map (2,).

        Returns the candidates that have become features.
        """
        self._observations += 1
        seen = [
            self._take(pose, z, covariance, transform_points(pose, ends), laser_map)
            for z, covariance, ends in zip(lines.z, lines.covariances, lines.ends, strict=True)
        ]
        ripe = [c for c in dict.fromkeys(seen) if c.observations >= self._min_observations]
        oldest = self._observations - self._max_misses
        self._all = [c for c in self._all if c.last_observed >= oldest and c not in ripe]
        return ripe

    def _take(
        self, pose: Array, z: Array, covariance: Array, ends_map: Array, laser_map: Array
    ) -> FeatureCandidate:
        """Update the candidate that an observed line matches, or add a new one."""
        line, _, by_seen = place_line(pose, z)
        # Two observations of a line differ by the noise of both; the robot has hardly moved.
        S = 2.0 * by_seen @ covariance @ by_seen.T
        for candidate in self._meeting(ends_map, laser_map):
            v, signs = line_difference(line, candidate.line)
            if mahalanobis(v, S) <= self._gate:
                candidate.line = v + signs * candidate.line
                candidate.span.grow(*interval(candidate.line, ends_map))
                candidate.z = z
                candidate.covariance = covariance
                candidate.observations += candidate.last_observed != self._observations
                candidate.last_observed = self._observations
                return candidate
        span = FeatureTrack(0, *interval(line, ends_map), laser_map)
        self._all.append(FeatureCandidate(line, span, z, covariance, 1, self._observations))
        return self._all[-1]

    def _meeting(self, ends_map: Array, laser_map: Array) -> list[FeatureCandidate]:
        if not self._all:
            return []
        lines = np.array([c.line for c in self._all])
        spans = [c.span for c in self._all]
        near = meeting(lines, spans, ends_map[None], laser_map, self._gap_m)[0]
        return [self._all[i] for i in np.flatnonzero(near)]
