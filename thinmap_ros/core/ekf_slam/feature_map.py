"""The line features of the map and their care.

How one enters, grows, is found to be another one, and leaves.

Source: EKF-SLAM/TI paper sections 2 and 4. The paper does not say when a feature enters or leaves;
here it enters after several sightings from different places, because what was only clutter would
stay in the state for ever, and leaves when several looks went through where it should be.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.config import parameter
from thinmap_ros.core.ekf_slam import local_area
from thinmap_ros.core.ekf_slam.association import AssociationConfig, associate, mahalanobis, meeting
from thinmap_ros.core.ekf_slam.ekf import EkfSlam
from thinmap_ros.core.ekf_slam.ekf_ti import CompressedEkf
from thinmap_ros.core.ekf_slam.feature_candidates import Candidate, Candidates
from thinmap_ros.core.ekf_slam.features import (
    Feature,
    LineFeature,
    as_seen,
    ends_of,
    interval,
    normals_of,
)
from thinmap_ros.core.ekf_slam.line_extraction import Lines
from thinmap_ros.core.ekf_slam.local_area import LocalArea
from thinmap_ros.core.ekf_slam.visibility import seen_through
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, transform_points
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_COUNT, MAX_ID, Field

_SPARE = 8  # features that the local area may hold beyond those it should
_ROUNDING = 1e-6  # of the largest variance, by which a covariance may fail to be one
FIELDS = {
    'ids': Field(np.int64, ('n',), 1, MAX_ID),
    'lines': Field(
        np.float64, ('n', 2), (-MAX_COORDINATE_M, -4.0 * np.pi), (MAX_COORDINATE_M, 4.0 * np.pi)
    ),
    'line_covariance': Field(np.float64, ('2n', '2n'), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    # low and high end along the line, x and y of where it was first seen from, missed
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
class FeatureConfig(AssociationConfig):
    """Parameters of the upkeep of features."""

    wall_sigma_m: float = parameter(
        0.02, 'how far real walls are from straight lines, 1 sigma, m', low=0.0, high=1.0
    )
    wall_sigma_rad: float = parameter(
        0.006, 'how far real walls are from straight lines, rad', low=0.0, high=0.5
    )
    sightings: int = parameter(4, 'a line enters the map after so many sightings', low=1, high=100)
    patience: int = parameter(
        15, 'a candidate not seen for so many looks is dropped', low=1, high=10_000
    )
    misses: int = parameter(
        5, 'a feature seen through by so many looks in a row leaves the map', low=1, high=1000
    )


class FeatureMap:
    """All features by id, those in the filter's local area, and lines that may become features.

    With local areas (EKF-SLAM/TI) association and update take the features of the local area;
    without, all.
    """

    def __init__(self, config: FeatureConfig, local_areas: bool) -> None:
        self.area = LocalArea()
        self._config = config
        self._local_areas = local_areas
        self._wall = np.diag(np.square([config.wall_sigma_m, config.wall_sigma_rad]))
        self._features: dict[int, Feature] = {}
        self._candidates = Candidates(config.sightings, config.patience, config.gate, config.gap_m)
        # Features outside the local area that the robot turned out to see.
        self._called: set[int] = set()
        self._next_id = 1

    def __len__(self) -> int:
        return len(self._features)

    def state(self, ekf: CompressedEkf) -> dict[str, NDArray[Any]]:
        """All features as arrays by name, with the covariance of their lines.

        Candidates are left out.
        """
        mean, covariance = ekf.settle()
        features = [self._features[i] for i in ekf.ids]
        spans = [(f.low, f.high, *f.seen_from, f.missed) for f in features]
        return {
            'ids': np.array(ekf.ids, dtype=np.int64),
            'lines': mean[3:].reshape(-1, 2),
            'line_covariance': covariance[3:, 3:],
            'spans': np.array(spans).reshape(-1, 5),
            'next_id': np.array(self._next_id),
            **self.area.state(),
        }

    def restore(self, ekf: CompressedEkf, state: Mapping[str, NDArray[Any]]) -> None:
        """Take up the `state` of another map, into an empty one and its filter.

        state: checked by FIELDS. Raises InputError where its arrays contradict each other.
        """
        _check_references(state)
        ids = state['ids'].tolist()
        self.area.restore(state)
        ekf.restore(ids, state['lines'], state['line_covariance'])
        self._features = {
            i: Feature(i, low, high, np.array([x, y]), int(missed))
            for i, (low, high, x, y, missed) in zip(ids, state['spans'].tolist(), strict=True)
        }
        self._next_id = int(state['next_id'])

    def listed(self, ekf: CompressedEkf) -> list[LineFeature]:
        """The features as others see them."""
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
        """Associate and correct the filter by the lines of a scan, then look after the features.

        learn: whether features may grow, come and go.
        Returns how many were matched, and whether the filter took the update.
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
        seen = self._grow(ekf, chosen[matched], lines.chosen(matched))
        ripe = self._candidates.take(ekf.local.pose, lines.chosen(unknown), laser_map)
        self._miss(ekf, seen, scan)
        self._merge(ekf, seen)
        new = [i for candidate in ripe for i in self._take_up(ekf, candidate)]
        self.area.store(ekf.local.pose, [i for i in (*seen, *new) if i in self._features])
        return len(matched), taken

    def _walls(self, lines: Lines) -> Array:
        """Covariances (K, 2, 2) of lines as real walls are off straight ones.

        By as much at their ends as anywhere: a short piece of wall tells its direction badly.
        """
        lengths = np.hypot(*(lines.ends[:, 1] - lines.ends[:, 0]).T)
        sigma_m = self._config.wall_sigma_m
        walls = np.zeros((len(lines), 2, 2))
        walls[:, 0, 0] = sigma_m**2
        walls[:, 1, 1] = np.square(sigma_m / np.maximum(lengths, sigma_m))
        return walls

    def _correct(
        self, ekf: CompressedEkf, lines: Lines, laser_map: Array
    ) -> tuple[NDArray[np.int64], bool]:
        """Update by the lines that can only be one feature, then by the others.

        Returns which feature each is (-1: none).
        """
        features = self._local(ekf)
        choice = associate(ekf.local, features, lines, laser_map, self._config)
        chosen = np.where(choice.ambiguous, -1, choice.index)
        taken = _update(ekf.local, chosen, lines)
        left = np.flatnonzero(choice.ambiguous)
        if left.size:
            again = associate(
                ekf.local, features, lines.chosen(left), laser_map, self._config
            ).index
            taken &= _update(ekf.local, again, lines.chosen(left))
            chosen[left] = again
        return chosen, taken

    def _local(self, ekf: CompressedEkf) -> list[Feature]:
        return [self._features[i] for i in ekf.area]

    def _choose_area(self, ekf: CompressedEkf, scan: Scan) -> None:
        """Have the filter enter the robot's area when it lacks some of it or holds much else."""
        half_view = 0.5 * abs(scan.angle_increment_rad) * scan.ranges_m.size
        wanted = self.area.features_near(ekf.local.pose, half_view) | self._called
        if not wanted <= set(ekf.area) or len(ekf.area) > len(wanted) + _SPARE:
            ekf.enter(sorted(wanted))
            self._called.clear()

    def _grow(self, ekf: CompressedEkf, indices: NDArray[np.int64], lines: Lines) -> list[int]:
        """Features become as long as what was seen of them; returns the ids of these."""
        for index, ends in zip(indices, lines.ends, strict=True):
            feature = self._features[ekf.area[index]]
            feature.grow(*interval(ekf.local.lines[index], transform_points(ekf.local.pose, ends)))
            feature.missed = 0
        return [ekf.area[i] for i in np.unique(indices)]

    def _miss(self, ekf: CompressedEkf, seen: Iterable[int], scan: Scan) -> None:
        """Features that the scan went through, time and again, leave."""
        through = seen_through(scan, ekf.local.pose, ekf.local.lines, self._local(ekf))
        for feature_id in [
            i for i, gone in zip(ekf.area, through, strict=True) if gone and i not in seen
        ]:
            self._features[feature_id].missed += 1
            if self._features[feature_id].missed >= self._config.misses:
                self._drop(ekf, feature_id, None)

    def _merge(self, ekf: CompressedEkf, seen: Iterable[int]) -> None:
        """Of the features just seen, those found to be another one are tied to it, and go."""
        for feature_id in seen:
            twin = self._twin(ekf, feature_id) if feature_id in self._features else None
            if twin is None:
                continue
            kept = min(feature_id, twin)
            dropped = max(feature_id, twin)
            a = ekf.area.index(kept)
            b = ekf.area.index(dropped)
            if ekf.local.tie(a, b, self._wall):
                ends = ends_of(self._features[dropped], ekf.local.lines[b])
                self._features[kept].grow(*interval(ekf.local.lines[a], ends))
                self._drop(ekf, dropped, kept)

    def _twin(self, ekf: CompressedEkf, feature_id: int) -> int | None:
        """Another feature that passes for the same wall.

        It meets this one, and their difference passes the gate.
        """
        index = ekf.area.index(feature_id)
        lines = ekf.local.lines
        ends = ends_of(self._features[feature_id], lines[index])
        near = meeting(
            lines, self._local(ekf), ends[None], self._features[feature_id].seen_from, 0.0
        )[0]
        for other in np.flatnonzero(near):
            if other != index and self._is_one_wall(ekf, index, int(other)):
                return ekf.area[other]
        return None

    def _is_one_wall(self, ekf: CompressedEkf, a: int, b: int) -> bool:
        v, S, _ = ekf.local.difference(a, b)
        ends = ends_of(self._features[ekf.area[b]], ekf.local.lines[b])
        apart = np.abs(ends @ normals_of(ekf.local.lines[[a]])[0] - ekf.local.lines[a, 0]).max()
        return bool(apart <= self._near) and mahalanobis(v, S + self._wall) <= self._config.gate

    @property
    def _near(self) -> float:
        """Distance between two lines that may yet be one wall, m."""
        return 3.0 * self._config.wall_sigma_m

    def _drop(self, ekf: CompressedEkf, feature_id: int, heir: int | None) -> None:
        ekf.remove(ekf.area.index(feature_id))
        self.area.forget(feature_id, heir)
        self._called.discard(feature_id)
        del self._features[feature_id]

    def _take_up(self, ekf: CompressedEkf, candidate: Candidate) -> list[int]:
        """Make a line a feature, unless it is one that the map has elsewhere.

        Returns the id of the new feature.
        """
        known = self._covering(ekf, candidate)
        if known:
            self._called |= known - set(ekf.area)
            return []
        feature_id = self._next_id
        self._next_id = self._next_id + 1
        index = ekf.add(feature_id, candidate.z, candidate.covariance)
        span = interval(ekf.local.lines[index], ends_of(candidate.span, candidate.line))
        self._features[feature_id] = Feature(feature_id, *span, candidate.span.seen_from)
        return [feature_id]

    def _covering(self, ekf: CompressedEkf, candidate: Candidate) -> set[int]:
        """Features that cover the candidate's place, though it failed the gate.

        Two for one wall help nobody.
        """
        if not self._features:
            return set()
        ids, lines = ekf.line_array()
        start, end = ends_of(candidate.span, candidate.line)
        middle = 0.5 * (start + end)
        reach = 0.25 * (end - start)
        near = np.abs(normals_of(lines) @ middle - lines[:, 0]) <= self._near
        # The few on whose lines it lies, of all that the map has.
        ids = ids[near]
        lines = lines[near]
        features = [self._features[i] for i in ids.tolist()]
        ends = np.stack([middle - reach, middle + reach])
        return set(
            ids[meeting(lines, features, ends[None], candidate.span.seen_from, 0.0)[0]].tolist()
        )


def _check_references(state: Mapping[str, NDArray[Any]]) -> None:
    """Raise InputError unless ids are unique and known, spans in order, and P a covariance."""
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
    """Whether a matrix (N, N) is symmetric and, but for rounding, positive semidefinite."""
    rounding = _ROUNDING * float(np.abs(P).max(initial=0.0))
    if np.abs(P - P.T).max(initial=0.0) > rounding:
        return False
    try:
        # A smallest variance that is no more than rounding error keeps it definite.
        np.linalg.cholesky(P + (rounding + 1e-12) * np.eye(len(P)))
    except np.linalg.LinAlgError:
        return False
    return True


def _update(ekf: EkfSlam, chosen: NDArray[np.int64], lines: Lines) -> bool:
    matched = np.flatnonzero(chosen >= 0)
    return ekf.update(chosen[matched], lines.z[matched], lines.covariances[matched])
