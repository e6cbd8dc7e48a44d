"""Lines that are not yet features.

Only what is seen several times, at the same place, becomes one.
"""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.ekf_slam.association import mahalanobis, meeting
from thinmap_ros.core.ekf_slam.ekf import line_difference
from thinmap_ros.core.ekf_slam.features import FeatureTrack, interval
from thinmap_ros.core.ekf_slam.line_extraction import Lines
from thinmap_ros.core.ekf_slam.models import place_line
from thinmap_ros.core.se2 import Array, transform_points


@dataclass(eq=False)
class FeatureCandidate:
    """A line (r, alpha) and what was seen of it, in the map.

    The last look as it was seen, z (2,) with covariance.
    """

    line: Array
    span: FeatureTrack
    z: Array
    covariance: Array
    observations: int
    last_observed: int


class FeatureCandidates:
    """The lines that have been seen too seldom so far."""

    def __init__(self, min_observations: int, max_misses: int, gate: float, gap_m: float) -> None:
        """min_observations: after so many a line is ripe.

        max_misses: observations without it after which it is dropped.
        """
        self._min_observations = min_observations
        self._max_misses = max_misses
        self._gate = gate
        self._gap_m = gap_m
        self._all: list[FeatureCandidate] = []
        self._observations = 0

    def update(self, pose: Array, lines: Lines, laser_map: Array) -> list[FeatureCandidate]:
        """Take in lines of a scan from a pose (3,), with the laser at a place (2,).

        Returns those that are ripe now.
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
        """The candidate that a seen line continues, brought up to date, or a new one."""
        line, _, by_seen = place_line(pose, z)
        # Two looks at one line differ by the noise of both; the robot hardly moved in between.
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
