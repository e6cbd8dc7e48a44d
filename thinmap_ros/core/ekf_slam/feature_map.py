"""Management of the line features: they are added, extended, merged and removed.

Source: EKF-SLAM/TI paper sections 2 and 4. The paper does not define when features are added or
removed. Here a feature is added after several observations, so that clutter does not enter the
state, and removed after several consecutive scans saw through it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.ekf_slam import local_area
from thinmap_ros.core.ekf_slam.association import AssociationConfig, associate, mahalanobis, meeting
from thinmap_ros.core.ekf_slam.ekf import EkfSlam
from thinmap_ros.core.ekf_slam.ekf_ti import CompressedEkf
from thinmap_ros.core.ekf_slam.feature_candidates import FeatureCandidate, FeatureCandidates
from thinmap_ros.core.ekf_slam.features import (
    FeatureTrack,
    LineFeature,
    Lines,
    as_seen,
    ends_of,
    interval,
    normals_of,
)
from thinmap_ros.core.ekf_slam.local_area import LocalArea
from thinmap_ros.core.ekf_slam.visibility import seen_through
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, transform_points
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_COUNT, MAX_ID, Field

# Standard deviations of real walls about a straight line; with less, the filter is overconfident.
WALL_FLATNESS_M = 0.02
_WALL_FLATNESS_RAD = 0.006
MAX_MISSES = 5  # consecutive scans through a feature until it is removed: a door has opened
_SPARE = 8  # additional features that may stay in the local area
_ROUNDING = 1e-6  # relative rounding error that is accepted in a covariance
FIELDS = {
    'ids': Field(np.int64, ('n',), 1, MAX_ID),
    'lines': Field(
        np.float64, ('n', 2), (-MAX_COORDINATE_M, -4.0 * np.pi), (MAX_COORDINATE_M, 4.0 * np.pi)
    ),
    'line_covariance': Field(np.float64, ('2n', '2n'), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    # low and high end along the line, x and y of first_seen_from, misses
    'spans': Field(
        np.float64,
        ('n', 5),
        (
            -2.0 * MAX_COORDINATE_M,
            -2.0 * MAX_COORDINATE_M,
            -MAX_COORDINATE_M,
            -MAX_COORDINATE_M,
            0.0,
        ),
        (
            2.0 * MAX_COORDINATE_M,
            2.0 * MAX_COORDINATE_M,
            MAX_COORDINATE_M,
            MAX_COORDINATE_M,
            float(MAX_COUNT),
        ),
    ),
    'next_id': Field(np.int64, (), 1, MAX_ID),
    **local_area.FIELDS,
}


@dataclass(frozen=True)
class FeatureConfig(Config):
    """Parameters of feature management."""

    min_observations: int = parameter(
        4,
        'Number of observations after which a line becomes a feature. Raise it against features '
        'on moving objects, lower it to use new walls sooner.',
        low=1,
        high=100,
    )
    candidate_max_misses: int = parameter(
        15,
        'Number of observations without a match after which a feature candidate is dropped. Raise '
        'it for walls that are often hidden.',
        low=1,
        high=10_000,
    )


class FeatureMap:
    """All features by id, the local area of the filter, and the feature candidates.

    With local areas (EKF-SLAM/TI) association and update use the features of the local area;
    without, they use all.
    """

    def __init__(
        self, config: FeatureConfig, association: AssociationConfig, local_areas: bool
    ) -> None:
        self.area = LocalArea()
        self._config = config
        self._association = association
        self._local_areas = local_areas
        self._wall = np.diag(np.square([WALL_FLATNESS_M, _WALL_FLATNESS_RAD]))
        self._features: dict[int, FeatureTrack] = {}
        self._candidates = FeatureCandidates(
            config.min_observations,
            config.candidate_max_misses,
            association.gate,
            association.max_gap_m,
        )
        # Features outside the local area that were observed, to be added to it.
        self._called: set[int] = set()
        self._next_id = 1

    def __len__(self) -> int:
        return len(self._features)

    def state(self, ekf: CompressedEkf) -> dict[str, NDArray[Any]]:
        """All features as arrays by name, with the covariance of their lines; no candidates."""
        mean, covariance = ekf.flush()
        features = [self._features[i] for i in ekf.ids]
        spans = [(f.low, f.high, *f.first_seen_from, f.misses) for f in features]
        return {
            'ids': np.array(ekf.ids, dtype=np.int64),
            'lines': mean[3:].reshape(-1, 2),
            'line_covariance': covariance[3:, 3:],
            'spans': np.array(spans).reshape(-1, 5),
            'next_id': np.array(self._next_id),
            **self.area.state(),
        }

    def restore(self, ekf: CompressedEkf, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore a saved `state` into an empty map and its filter.

        state: checked by FIELDS. Raises InputError if its arrays are inconsistent.
        """
        _check_references(state)
        ids = state['ids'].tolist()
        self.area.restore(state)
        ekf.restore(ids, state['lines'], state['line_covariance'])
        self._features = {
            i: FeatureTrack(i, low, high, np.array([x, y]), int(missed))
            for i, (low, high, x, y, missed) in zip(ids, state['spans'].tolist(), strict=True)
        }
        self._next_id = int(state['next_id'])

    def line_features(self, ekf: CompressedEkf) -> list[LineFeature]:
        """All features, with their current lines."""
        lines = ekf.lines()
        covariances = ekf.line_covariances()
        local = set(ekf.area)
        return [
            as_seen(feature, lines[i].copy(), covariances[i], self.area.nodes_of(i), i in local)
            for i, feature in self._features.items()
        ]

    def observe(
        self,
        ekf: CompressedEkf,
        lines: Lines,
        scan: Scan,
        learn: bool = True,
    ) -> tuple[int, bool]:
        """Associate the lines of a scan, update the filter, and manage the features.

        learn: whether features may be added, extended, merged and removed.
        Returns the number of matched lines, and whether the filter update was possible.
        """
        if self._local_areas:
            self._choose_area(ekf, scan)
        lines = Lines(lines.z, lines.covariances + self._walls(lines), lines.ends)
        laser_map = transform_points(ekf.local.pose, scan.T_base_laser[None, :2])[0]
        chosen, taken = self._correct(ekf, lines, laser_map)
        matched = np.flatnonzero(chosen >= 0)
        unknown = np.flatnonzero(chosen < 0)
        if not learn:
            return len(matched), taken
        seen = self._grow(ekf, chosen[matched], lines.select(matched))
        ripe = self._candidates.update(ekf.local.pose, lines.select(unknown), laser_map)
        self._miss(ekf, seen, scan)
        self._merge(ekf, seen)
        new = [i for candidate in ripe for i in self._take_up(ekf, candidate)]
        self.area.store(ekf.local.pose, [i for i in (*seen, *new) if i in self._features])
        return len(matched), taken

    def _walls(self, lines: Lines) -> Array:
        """Covariances (K, 2, 2) of lines due to the flatness of real walls.

        The error at the ends is the same as elsewhere, so a short line has an uncertain direction.
        """
        lengths = np.hypot(*(lines.ends[:, 1] - lines.ends[:, 0]).T)
        sigma_m = WALL_FLATNESS_M
        walls = np.zeros((len(lines), 2, 2))
        walls[:, 0, 0] = sigma_m**2
        walls[:, 1, 1] = np.square(sigma_m / np.maximum(lengths, sigma_m))
        return walls

    def _correct(
        self, ekf: CompressedEkf, lines: Lines, laser_map: Array
    ) -> tuple[NDArray[np.int64], bool]:
        """Update by the unambiguous lines, then by the others.

        Returns the index of the feature of each line (-1: none), and whether both were possible.
        """
        features = self._local(ekf)
        choice = associate(ekf.local, features, lines, laser_map, self._association)
        chosen = np.where(choice.ambiguous, -1, choice.index)
        taken = _update(ekf.local, chosen, lines)
        left = np.flatnonzero(choice.ambiguous)
        if left.size:
            again = associate(
                ekf.local, features, lines.select(left), laser_map, self._association
            ).index
            taken &= _update(ekf.local, again, lines.select(left))
            chosen[left] = again
        return chosen, taken

    def _local(self, ekf: CompressedEkf) -> list[FeatureTrack]:
        return [self._features[i] for i in ekf.area]

    def _choose_area(self, ekf: CompressedEkf, scan: Scan) -> None:
        """Set the filter's area if features are missing, or if it holds too many others."""
        half_view = 0.5 * abs(scan.angle_increment_rad) * scan.ranges_m.size
        wanted = self.area.features_near(ekf.local.pose, half_view) | self._called
        if not wanted <= set(ekf.area) or len(ekf.area) > len(wanted) + _SPARE:
            ekf.set_local_area(sorted(wanted))
            self._called.clear()

    def _grow(self, ekf: CompressedEkf, indices: NDArray[np.int64], lines: Lines) -> list[int]:
        """Extend features by the observed segments; returns their ids."""
        for index, ends in zip(indices, lines.ends, strict=True):
            feature = self._features[ekf.area[index]]
            feature.grow(*interval(ekf.local.lines[index], transform_points(ekf.local.pose, ends)))
            feature.misses = 0
        return [ekf.area[i] for i in np.unique(indices)]

    def _miss(self, ekf: CompressedEkf, seen: Iterable[int], scan: Scan) -> None:
        """Count the features that the scan saw through; remove those with too many misses."""
        through = seen_through(scan, ekf.local.pose, ekf.local.lines, self._local(ekf))
        for feature_id in [
            i for i, gone in zip(ekf.area, through, strict=True) if gone and i not in seen
        ]:
            self._features[feature_id].misses += 1
            if self._features[feature_id].misses >= MAX_MISSES:
                self._drop(ekf, feature_id, None)

    def _merge(self, ekf: CompressedEkf, seen: Iterable[int]) -> None:
        """Merge observed features that are the same wall as another feature."""
        for feature_id in seen:
            twin = self._twin(ekf, feature_id) if feature_id in self._features else None
            if twin is None:
                continue
            kept = min(feature_id, twin)
            dropped = max(feature_id, twin)
            a = ekf.area.index(kept)
            b = ekf.area.index(dropped)
            if ekf.local.merge(a, b, self._wall):
                ends = ends_of(self._features[dropped], ekf.local.lines[b])
                self._features[kept].grow(*interval(ekf.local.lines[a], ends))
                self._drop(ekf, dropped, kept)

    def _twin(self, ekf: CompressedEkf, feature_id: int) -> int | None:
        """Another feature that is the same wall, or None.

        Their intervals overlap, and their difference passes the gate.
        """
        index = ekf.area.index(feature_id)
        lines = ekf.local.lines
        ends = ends_of(self._features[feature_id], lines[index])
        near = meeting(
            lines, self._local(ekf), ends[None], self._features[feature_id].first_seen_from, 0.0
        )[0]
        for other in np.flatnonzero(near):
            if other != index and self._is_one_wall(ekf, index, int(other)):
                return ekf.area[other]
        return None

    def _is_one_wall(self, ekf: CompressedEkf, a: int, b: int) -> bool:
        v, S, _ = ekf.local.difference(a, b)
        ends = ends_of(self._features[ekf.area[b]], ekf.local.lines[b])
        apart = np.abs(ends @ normals_of(ekf.local.lines[[a]])[0] - ekf.local.lines[a, 0]).max()
        return (
            bool(apart <= self._near) and mahalanobis(v, S + self._wall) <= self._association.gate
        )

    @property
    def _near(self) -> float:
        """Largest distance between two lines that may be one wall, m."""
        return 3.0 * WALL_FLATNESS_M

    def _drop(self, ekf: CompressedEkf, feature_id: int, heir: int | None) -> None:
        ekf.remove(ekf.area.index(feature_id))
        self.area.remove(feature_id, heir)
        self._called.discard(feature_id)
        del self._features[feature_id]

    def _take_up(self, ekf: CompressedEkf, candidate: FeatureCandidate) -> list[int]:
        """Add a candidate as a feature, unless existing features cover it.

        Returns the id of the new feature, or an empty list.
        """
        known = self._covering(ekf, candidate)
        if known:
            self._called |= known - set(ekf.area)
            return []
        feature_id = self._next_id
        self._next_id = self._next_id + 1
        index = ekf.add(feature_id, candidate.z, candidate.covariance)
        span = interval(ekf.local.lines[index], ends_of(candidate.span, candidate.line))
        self._features[feature_id] = FeatureTrack(feature_id, *span, candidate.span.first_seen_from)
        return [feature_id]

    def _covering(self, ekf: CompressedEkf, candidate: FeatureCandidate) -> set[int]:
        """Ids of features that cover the candidate although it failed their gate.

        Prevents duplicate features of one wall.
        """
        if not self._features:
            return set()
        ids, lines = ekf.line_array()
        start, end = ends_of(candidate.span, candidate.line)
        middle = 0.5 * (start + end)
        reach = 0.25 * (end - start)
        near = np.abs(normals_of(lines) @ middle - lines[:, 0]) <= self._near
        # Only features whose lines are near the candidate.
        ids = ids[near]
        lines = lines[near]
        features = [self._features[i] for i in ids.tolist()]
        ends = np.stack([middle - reach, middle + reach])
        return set(
            ids[
                meeting(lines, features, ends[None], candidate.span.first_seen_from, 0.0)[0]
            ].tolist()
        )


def _check_references(state: Mapping[str, NDArray[Any]]) -> None:
    """Raise InputError unless ids are unique and known, spans ordered, and P is a covariance."""
    ids = state['ids']
    spans = state['spans']
    snapshot.require_unique(ids, 'features: id')
    last = int(ids.max(initial=0))
    next_id = int(state['next_id'])
    snapshot.require(last < next_id, f'features: next id {next_id}', f'above {last}')
    snapshot.require_known(state['stored_at'][:, 0], ids, 'features: stored feature')
    in_order = bool((spans[:, 0] <= spans[:, 1]).all())
    snapshot.require(in_order, 'features: spans', 'low ends below high ends')
    is_covariance = _is_covariance(state['line_covariance'])
    expected = 'a symmetric matrix without negative variances'
    snapshot.require(is_covariance, 'features: line_covariance', expected)


def _is_covariance(P: Array) -> bool:
    """Whether a matrix (N, N) is symmetric and positive semidefinite up to rounding."""
    rounding = _ROUNDING * float(np.abs(P).max(initial=0.0))
    if np.abs(P - P.T).max(initial=0.0) > rounding:
        return False
    try:
        # The added variance, of the size of rounding errors, makes a semidefinite matrix definite.
        np.linalg.cholesky(P + (rounding + 1e-12) * np.eye(len(P)))
    except np.linalg.LinAlgError:
        return False
    return True


def _update(ekf: EkfSlam, chosen: NDArray[np.int64], lines: Lines) -> bool:
    matched = np.flatnonzero(chosen >= 0)
    return ekf.update(chosen[matched], lines.z[matched], lines.covariances[matched])
