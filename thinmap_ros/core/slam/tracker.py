"""The pose of each scan: predicted by odometry, measured by a match with the local map."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.features import odometry_slip
from thinmap_ros.core.scan import Scan, few_beams_reason
from thinmap_ros.core.se2 import BOUND_SIGMAS, Array, rotated_covariance, rotation
from thinmap_ros.core.slam.graph.keyframes import Anchor
from thinmap_ros.core.slam.localizer_config import LocalizerConfig
from thinmap_ros.core.slam.map_evidence import INLIERS_PER_CONTRADICTION, MapEvidence
from thinmap_ros.core.slam.matching.local_map import LocalMap
from thinmap_ros.core.slam.matching.scan_matcher import MIN_POINTS, Match, Matcher
from thinmap_ros.core.slam.matching.visibility import (
    NOTHING,
    SeenThrough,
    misses_walls,
    seen_through,
)
from thinmap_ros.core.slam.odometry_prediction import OdometryPrediction, Prediction
from thinmap_ros.core.slam.track import Track

_NO_RETURNS = 'no returns from walls of the map'


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What a scan is matched with: the local map, and the anchor of the pose in it.

    revision: number of corrections of the map so far; has_keyframes: whether there are any;
    is_apart: whether the place of the local map in the published one is unknown.
    """

    local_map: LocalMap
    anchor: Anchor
    revision: int
    has_keyframes: bool
    is_apart: bool


@dataclass(frozen=True, eq=False)
class Tracked:
    """How a scan was tracked: its match, map frame, or None; fits: whether it set the pose.

    discontinuity: description of an odometry jump; blind_reason: why the laser does not confirm the
    pose; both are '' without one.
    """

    match: Match | None
    fits: bool
    discontinuity: str
    blind_reason: str


class Tracker:
    """Predicts, matches and updates the pose relative to the anchor."""

    def __init__(self, config: LocalizerConfig) -> None:
        self._config = config
        self._matcher = Matcher(config.matching)
        self.prediction = OdometryPrediction(config.odometry)
        start = se2.pose(config.initial_x_m, config.initial_y_m, config.initial_yaw_rad)
        evidence = MapEvidence(config.lost_threshold, config.matching.min_inlier_ratio)
        self.track = Track(start, evidence)

    def adjust(self, config: LocalizerConfig) -> None:
        """Continue with other values of `LIVE_PARAMETERS`."""
        self._config = config
        self._matcher = Matcher(config.matching)
        self.track.evidence.adjust(config.lost_threshold, config.matching.min_inlier_ratio)

    def step(self, scan: Scan, points: Array, T_odom_base: Array, there: Surroundings) -> Tracked:
        """Track a scan with surface points (N, 5), given the odometry pose (3,) at its stamp.

        Where an error ends it, the scan is left out, and the motion up to it is not.
        """
        track = self.track
        before = track.T_anchor_base
        prediction = self.prediction.predict(scan, T_odom_base, before, there.revision)
        is_stationary = self._is_stationary(prediction)
        by_calibration = rotation(float(before[2])) @ prediction.motion.by_calibration
        track.uncertainty.predict(
            before, prediction.prior, prediction.covariance, is_stationary, by_calibration
        )
        track.reckoned = track.reckoned.moved(prediction)
        try:
            return self._measure(scan, points, prediction, is_stationary, there)
        except Exception:
            track.T_anchor_base = prediction.prior
            track.uncertainty.coast(prediction.prior, prediction.covariance, is_stationary)
            raise

    def _measure(
        self,
        scan: Scan,
        points: Array,
        prediction: Prediction,
        is_stationary: bool,
        there: Surroundings,
    ) -> Tracked:
        """Match a scan at its predicted pose, and update the pose by it."""
        track = self.track
        before = prediction.before
        match = self._match(scan, points, prediction.prior, there)
        moved_m = 0.0 if is_stationary else float(np.hypot(*(prediction.prior - before)[:2]))
        through = self._seen_through(scan, match, there)
        track.evidence.update(match, through, is_stationary, moved_m)
        own = None if match is None else match.seen_from(there.anchor.T_map)
        fits = self._update(own, prediction, is_stationary)
        if fits and match is not None:
            systematic = self.systematic(there.anchor)
            self.prediction.calibration.update(match.pose, match.scan_information, systematic)
        track.record_agreement()
        blind_reason = self._blind_reason(scan, points, match, there)
        return Tracked(match, fits, prediction.discontinuity, blind_reason)

    def place(self, T_anchor_base: Array, covariance: Array) -> None:
        """Set the pose (3,) with covariance (3, 3), relative to the anchor."""
        self.prediction.reset_segment()
        self.track.place(T_anchor_base, covariance)

    def fall_back(self) -> Array:
        """Return to the dead-reckoned pose: later matches, as in a crowd, are not reliable.

        Returns its covariance (3, 3).
        """
        self.prediction.reset_segment()
        reckoned = self.track.reckoned
        self.track.T_anchor_base = reckoned.T_anchor_base
        return reckoned.covariance + self.slip_covariance()

    def slip_covariance(self) -> Array:
        """Covariance (3, 3) of a pose after the largest expected wheel slip."""
        return np.diag(np.square(BOUND_SIGMAS * np.array(self._config.matching.wheel_slip)))

    def random_covariance(self, anchor: Anchor) -> Array:
        """Covariance (3, 3) of the independent errors of the pose, map frame."""
        uncertainty = self.track.uncertainty
        return anchor.covariance_at(uncertainty.T_moved, uncertainty.since_anchor)

    def systematic(self, anchor: Anchor) -> Array:
        """Derivative (3, 4) of the pose by the calibration of the odometry, map frame."""
        uncertainty = self.track.uncertainty
        return anchor.systematic_at(uncertainty.T_moved, uncertainty.systematic)

    def covariance(self, anchor: Anchor) -> Array:
        """Covariance (3, 3) of the pose, map frame."""
        systematic = self.prediction.calibration.covariance_of(self.systematic(anchor))
        total = self.random_covariance(anchor) + systematic
        return np.asarray(0.5 * (total + total.T))

    def _is_stationary(self, prediction: Prediction) -> bool:
        """Whether the robot has moved by no more than the odometry noise."""
        slip = BOUND_SIGMAS * odometry_slip(self._config.odometry)
        is_still = self.track.uncertainty.is_stationary(prediction.prior, slip)
        return prediction.motion.is_stationary and is_still

    def _match(self, scan: Scan, points: Array, prior: Array, there: Surroundings) -> Match | None:
        """Match a scan with the local map; None if scan or map have too little structure."""
        if len(points) < MIN_POINTS or there.local_map.is_empty:
            return None
        if np.ptp(points[:, :2], axis=0).max() < self._config.local_map.resolution_m:
            return None  # all points in one cell do not determine a pose
        T_map = there.anchor.T_map
        covariance = rotated_covariance(self.track.uncertainty.since_match, float(T_map[2]))
        prior = there.anchor.pose(prior)
        return self._matcher.match(points, scan.T_base_laser, there.local_map, prior, covariance)

    def _seen_through(self, scan: Scan, match: Match | None, there: Surroundings) -> SeenThrough:
        """Walls of the map that this localizer makes, and that a scan sees through.

        In a map that does not change, the inliers alone tell where the robot is; and its furniture
        may have changed.
        """
        if match is None or not self._config.is_mapping:
            return NOTHING
        # At a given pose no drift explains them: it is right or wrong.
        is_given = self.track.evidence.is_delocalized
        covariance = np.zeros((3, 3)) if is_given else self.covariance(there.anchor)
        return seen_through(scan, there.local_map, match.pose, covariance)

    def _update(self, match: Match | None, prediction: Prediction, is_stationary: bool) -> bool:
        """Set the pose to that of an accepted match, or else to the predicted one.

        match: relative to the anchor. Returns whether it was accepted and fits.
        """
        prior = prediction.prior
        uncertainty = self.track.uncertainty
        is_unexpected = match is not None and uncertainty.is_unexpected(match, prior)
        accepted = match is not None and not self._is_rejected(match, is_unexpected)
        # After set_pose an innovation is due to the given pose, and not to the odometry.
        if match is not None and is_unexpected and not self.track.evidence.is_delocalized:
            self.prediction.contradict(prediction, match, accepted)
        if match is None or not accepted:
            self.track.T_anchor_base = prior
            uncertainty.coast(prior, prediction.covariance, is_stationary)
            return False
        self.track.T_anchor_base = match.pose
        fits = match.inlier_ratio >= self._config.matching.min_inlier_ratio
        uncertainty.update(match, prior, prediction.covariance, fits, is_stationary)
        if fits:
            self.prediction.update(prediction, match)
        return fits

    def _is_rejected(self, match: Match, is_unexpected: bool) -> bool:
        """Whether the pose of a match is worse than the predicted one.

        An unexpected match is, if many of its points contradict the map. After scans that could
        not be matched, one that fits badly is: a few points fit somewhere within a wide prior.
        """
        if self.track.evidence.is_delocalized:
            return False
        if is_unexpected and (
            match.inlier_ratio < INLIERS_PER_CONTRADICTION * match.contradiction_ratio
        ):
            return True
        is_wide = self._config.matching.is_wide(self.track.uncertainty.since_match)
        return self.track.evidence.is_unconfirmed and is_wide

    def _blind_reason(
        self, scan: Scan, points: Array, match: Match | None, there: Surroundings
    ) -> str:
        """Why the laser does not confirm the pose; '' if it does, or if no wall is in range."""
        if match is not None or scan.is_blind:
            return scan.blind_reason
        has_confirmed = not self._config.is_mapping or there.has_keyframes
        is_confirmed = has_confirmed and not self.track.evidence.is_delocalized
        sparse_reason = few_beams_reason(scan) or _sparse_reason(scan, points, is_confirmed)
        if sparse_reason or there.is_apart or self.track.evidence.is_lost:
            return sparse_reason
        T_map_base = there.anchor.pose(self.track.T_anchor_base)
        covariance = self.track.uncertainty.since_match
        misses = misses_walls(scan, there.local_map, T_map_base, covariance)
        return _NO_RETURNS if misses else ''


def _sparse_reason(scan: Scan, points: Array, is_confirmed: bool) -> str:
    """Why walls in range do not confirm a pose that no scan has confirmed; '' if they may.

    Behind a room, in a hall with isolated posts, the pose is one that scans have confirmed.
    """
    hits = int(np.count_nonzero(scan.hit))
    is_sparse = len(points) < MIN_POINTS <= hits
    if not is_sparse or is_confirmed:
        return ''
    return (
        f'{hits} returns, {len(points)} of them side by side on a surface: '
        f'expected at least {MIN_POINTS}'
    )
