"""The localizer: one step for each scan, live and offline.

Calibrated odometry predicts the pose, and scan-to-map matching corrects it. The scan is added to
the local map when the robot has moved far enough. Keyframes and loop closure keep the map globally
consistent. If scans contradict the local map, a new one is started. A dead-reckoned edge with the
accumulated covariance connects the two.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import parameter, parameters_of, part
from thinmap_ros.core.covariances import rotated_covariance, rotation
from thinmap_ros.core.ekf_slam.features import LineFeature
from thinmap_ros.core.ekf_slam.line_extraction import LineConfig
from thinmap_ros.core.ekf_slam.models import odometry_slip, odometry_variances
from thinmap_ros.core.estimate import Correction, Estimate
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.odometry import OdometryAnchor
from thinmap_ros.core.scan import Scan, few_beams_reason
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.active_map import ActiveMap
from thinmap_ros.core.slam.covariance import NO_DERIVATIVE, UNKNOWN, PoseUncertainty
from thinmap_ros.core.slam.graph.keyframes import (
    Keyframe,
    KeyframeConfig,
    Step,
    heading_errors,
    with_heading,
)
from thinmap_ros.core.slam.graph.loop_closure import LoopClosure, LoopClosureConfig
from thinmap_ros.core.slam.graph.pose_graph import Systematic
from thinmap_ros.core.slam.graph.trajectory import KeyframeTrajectory
from thinmap_ros.core.slam.heading import HeadingCorrection
from thinmap_ros.core.slam.matching import local_map
from thinmap_ros.core.slam.matching.local_map import LocalMapConfig
from thinmap_ros.core.slam.matching.occupancy_surfaces import free_cells, occupied_surface_points
from thinmap_ros.core.slam.matching.scan_matcher import (
    MIN_POINTS,
    Match,
    Matcher,
    MatchingConfig,
)
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.slam.matching.visibility import misses_walls, seen_through_ratio
from thinmap_ros.core.slam.motion_model import MotionConfig
from thinmap_ros.core.slam.odometry_prediction import OdometryPrediction, Prediction
from thinmap_ros.core.slam.tracking import INLIERS_PER_CONTRADICTION, Tracking
from thinmap_ros.core.slam.wall_compass import Reference
from thinmap_ros.core.start import SCAN_MATCHING, StartConfig
from thinmap_ros.core.topology.graph import TopologicalMap

_SIGMAS = 3.0
_NO_RETURNS = 'no returns from walls of the map'
_VIEW_M = 1.0  # path length after which the errors of two matches are independent


@dataclass(frozen=True)
class LocalizerConfig(StartConfig):
    """Parameters of the localizer and of its parts."""

    of_slam: ClassVar[tuple[str, ...]] = (SCAN_MATCHING,)

    lost_threshold: float = parameter(
        4.0,
        'Evidence against the map at which the robot is lost and a new submap begins: the sum over '
        'scans of the ratio of points that contradict the map, minus a third of the inlier ratio. '
        'Raise it in crowded places, lower it to detect a kidnapped robot earlier.',
        low=0.1,
        high=1000.0,
    )
    odometry: MotionConfig = part(MotionConfig)
    lines: LineConfig = part(LineConfig)
    matching: MatchingConfig = part(MatchingConfig)
    local_map: LocalMapConfig = part(LocalMapConfig)
    keyframes: KeyframeConfig = part(KeyframeConfig)
    loop_closure: LoopClosureConfig = part(LoopClosureConfig)


# What can change while a map is kept: `Localizer.adjust`.
LIVE_PARAMETERS = (
    'lost_threshold',
    *(f'matching.{name}' for name, _, _ in parameters_of(MatchingConfig())),
    *(f'loop_closure.{name}' for name, _, _ in parameters_of(LoopClosureConfig())),
)


class Localizer:
    """Scan matching with a local map, keyframes and loop closure.

    Input that is not finite is counted in `rejected`; a rejected odometry pose means no motion.
    """

    def __init__(self, config: LocalizerConfig | None = None) -> None:
        self.config = config or LocalizerConfig()
        self._matcher = Matcher(self.config.matching)
        self._rejected = 0
        self.reset()

    def reset(self) -> None:
        """Discard map, path and pose; the next scan starts at the configured initial pose."""
        config = self.config
        self._pose = se2.pose(config.initial_x_m, config.initial_y_m, config.initial_yaw_rad)
        self._prediction = OdometryPrediction(config.odometry)
        self._uncertainty = PoseUncertainty(self._pose)
        self._tracking = Tracking(
            config.lost_threshold, config.matching.min_inlier_ratio, self._pose
        )
        self._heading = HeadingCorrection(config.lines)
        self._loops = LoopClosure(
            config.loop_closure,
            config.keyframes,
            config.matching,
            config.local_map,
            self._prediction.calibration,
        )
        self._map = ActiveMap(config.local_map, self._loops.pieces)
        self._path = KeyframeTrajectory()

    def adjust(self, config: LocalizerConfig) -> None:
        """Continue with other values of `LIVE_PARAMETERS`; map, path and pose stay."""
        self.config = replace(
            self.config,
            lost_threshold=config.lost_threshold,
            matching=config.matching,
            loop_closure=config.loop_closure,
        )
        self._matcher = Matcher(config.matching)
        self._tracking.adjust(config.lost_threshold, config.matching.min_inlier_ratio)
        self._loops.adjust(config.loop_closure, config.matching)

    @property
    def rejected(self) -> int:
        """Number of odometry poses and `set_pose` calls with invalid values.

        And of scans that lie too far from the others for one map.
        """
        return self._rejected + self._prediction.rejected + self._map.refused

    @property
    def pose(self) -> Array:
        """Current pose T_map_base (3,), a copy."""
        return self._pose.copy()

    @property
    def keyframes(self) -> list[Keyframe]:
        """The keyframes, at their optimized poses."""
        return self._loops.keyframes.frames

    @property
    def features(self) -> list[LineFeature]:
        """Line features of the map: none, as it is made of scan points."""
        return []

    def set_topology(self, topology: TopologicalMap) -> None:
        """Ignore the topological map, with which only a filter selects its local area."""

    def set_pose(self, T_map_base: Array, covariance: Array) -> None:
        """Set the pose (3,) with covariance (3, 3) in the current map.

        The map is not updated until scans confirm the pose. In a map that does not change, the
        robot is lost until then. A piece of map that is apart is left: the pose is in the published
        map.
        """
        if not (se2.is_bounded_pose(T_map_base) and np.isfinite(covariance).all()):
            self._rejected += 1
            return
        self._pose = se2.pose(*T_map_base.tolist())
        self._uncertainty.place(self._pose, covariance)
        self._prediction.reset_segment()
        is_map_given = not self.config.is_mapping
        self._tracking.place(self._pose, self._uncertainty.since_match, is_map_given)
        self._loops.pieces.return_to_published()
        self._map.rerender(self.keyframes, self._pose)

    def state(self) -> dict[str, NDArray[Any]]:
        """The published local map as arrays by name, for `from_state`; without the pose."""
        return self._map.published(self.keyframes).state()

    @staticmethod
    def from_state(
        state: Mapping[str, NDArray[Any]], config: LocalizerConfig | None = None
    ) -> 'Localizer':
        """Localizer in the local map of a saved `state`, at the configured initial pose.

        It is delocalized until scans fit. Raises InputError if the state is invalid.
        """
        checked = snapshot.validate(state, local_map.FIELDS, 'local map')
        possible = bool((checked['hits'] <= checked['seen']).all())
        snapshot.require(
            possible, 'local map: hits: more than observations', 'no more hits than observations'
        )
        localizer = Localizer(config)
        localizer._map.map.restore(checked)
        localizer._start_delocalized(checked)
        return localizer

    @staticmethod
    def in_occupancy_map(patch: GridPatch, config: LocalizerConfig | None = None) -> 'Localizer':
        """Localizer in an occupancy map, at the configured initial pose.

        It is delocalized until scans fit.
        """
        localizer = Localizer(config)
        local = localizer._map.map
        local.add_free_cells(*free_cells(patch, local.config.resolution_m))
        for faces in occupied_surface_points(patch):
            local.add_walls(faces.points, faces.normal)
        localizer._start_delocalized(local.state())
        return localizer

    @staticmethod
    def from_occupancy_map(
        patch: GridPatch,
        last: OdometryAnchor,
        T_odom_base: Array,
        config: LocalizerConfig | None = None,
    ) -> 'Localizer':
        """Localizer that resumes in an occupancy map, after the odometry motion since `last`.

        T_odom_base (3,): odometry pose now. The standard deviation of the pose is the odometry
        noise since `last` plus one cell of the map (in rad, too, for the heading).
        """
        localizer = Localizer.in_occupancy_map(patch, config)
        moved = se2.between(last.T_odom_base, T_odom_base)
        turn = float(last.T_map_odom[2] + last.T_odom_base[2])
        variances = odometry_variances(moved, localizer.config.odometry)
        cell = np.full(3, patch.frame.resolution)
        localizer.set_pose(
            se2.compose(last.T_map_odom, T_odom_base),
            rotated_covariance(np.diag(variances), turn) + np.diag(np.square(cell)),
        )
        return localizer

    def step(self, scan: Scan, T_odom_base: Array) -> Estimate:
        """Estimate the pose of a scan, given the odometry pose (3,) at its stamp; update the map.

        One step: predict, match, update the pose, update the map, close loops.
        """
        prediction = self._prediction.predict(scan, T_odom_base, self._pose)
        is_stationary = self._is_stationary(prediction)
        by_calibration = rotation(float(self._pose[2])) @ prediction.motion.by_calibration
        self._uncertainty.predict(
            self._pose, prediction.T_map_base, prediction.covariance, is_stationary, by_calibration
        )
        points = surface_points(scan)
        match = self._match(scan, points, prediction.T_map_base)
        self._tracking.dead_reckoned = self._tracking.dead_reckoned.moved(prediction)
        self._tracking.update(match, self._seen_through_ratio(scan, match), is_stationary)
        fitting = self._update(match, prediction, is_stationary)
        self._tracking.record_pose(self._pose, self._uncertainty.since_match)
        blind_reason = self._blind_reason(scan, points, match)
        if not self.config.is_mapping:
            self._detect_loss()
        elif not self._tracking.is_delocalized:
            self._update_map(scan, points)
        elif self._tracking.needs_submap:
            self._start_submap()  # the robot is not where it was placed
        correction = self._close_loops()
        self._map.render(self.keyframes)
        self._record_pose(scan)
        estimate = self._estimate(match, correction, blind_reason)
        return replace(
            estimate,
            odometry_discontinuity=prediction.discontinuity,
            scan_information=None if fitting is None else fitting.scan_information,
        )

    def optimized_trajectory(self) -> Array:
        """Poses (N, 3) of all steps since the start, after all corrections.

        Pending matches are done, and the pose is corrected by them.
        """
        while self._loops.is_busy:
            self._close_loops()
        return self._path.poses(self._loops.finish())

    def keyframe_trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (N,) in ns and optimized poses (N, 3) of the keyframe scans along the path.

        Each other scan keeps its pose relative to the keyframe before it.
        """
        return self._loops.keyframes.path()

    def known_places(self) -> Array:
        """Places (N, 2) that enclose the published map: cells, and keyframes, m."""
        is_published = self._loops.pieces.is_published
        keyframes = [frame.T_map_base[:2] for frame in self.keyframes if is_published(frame.submap)]
        cells = self._map.published(self.keyframes).corners()
        return np.vstack([cells, np.array(keyframes).reshape(-1, 2)])

    @property
    def _is_lost(self) -> bool:
        """Whether the place of the robot in the published map is unknown."""
        return self._loops.pieces.is_apart or self._tracking.is_lost

    def _start_delocalized(self, given: Mapping[str, NDArray[Any]]) -> None:
        """Start in a loaded local map: delocalized until scans fit."""
        self._map.load(given)
        self._tracking.start_delocalized()
        self._uncertainty.place(self._pose, self._slip_covariance())

    def _detect_loss(self) -> None:
        """In a map that does not change, the robot is delocalized if scans contradict it.

        Dead reckoning continues from the last scan that agreed.
        """
        if self._tracking.is_delocalized or not self._tracking.needs_submap:
            return
        dead_reckoned = self._tracking.dead_reckoned
        self._pose = dead_reckoned.T_map_base
        self._prediction.reset_segment()
        covariance = dead_reckoned.covariance + self._slip_covariance()
        self._uncertainty.place(self._pose, covariance)
        self._tracking.lose()

    def _slip_covariance(self) -> Array:
        """Covariance (3, 3) of a pose after the largest expected wheel slip."""
        config = self.config.matching
        slip = np.array([*[config.wheel_slip_m] * 2, config.wheel_slip_rad])
        return np.diag(np.square(_SIGMAS * slip))

    def _is_stationary(self, prediction: Prediction) -> bool:
        """Whether the robot has moved by no more than the odometry noise."""
        slip = _SIGMAS * odometry_slip(self.config.odometry)
        is_still = self._uncertainty.is_stationary(prediction.T_map_base, slip)
        return prediction.motion.is_stationary and is_still

    def _match(self, scan: Scan, points: Array, prior: Array) -> Match | None:
        """Match a scan with the local map; None if scan or map have too little structure."""
        if len(points) < MIN_POINTS or self._map.map.is_empty:
            return None
        if np.ptp(points[:, :2], axis=0).max() < self.config.local_map.resolution_m:
            return None  # all points in one cell do not determine a pose
        covariance = self._uncertainty.since_match
        return self._matcher.match(points, scan.T_base_laser, self._map.map, prior, covariance)

    def _seen_through_ratio(self, scan: Scan, match: Match | None) -> float:
        """Ratio of returns behind walls of the map that this localizer makes.

        In a map that does not change, the inliers alone tell where the robot is; and its furniture
        may have changed.
        """
        if match is None or not self.config.is_mapping:
            return 0.0
        # At a given pose no drift explains them: it is right or wrong.
        is_given = self._tracking.is_delocalized
        covariance = np.zeros((3, 3)) if is_given else self._covariance()
        return seen_through_ratio(scan, self._map.map, match.T_map_base, covariance)

    def _blind_reason(self, scan: Scan, points: Array, match: Match | None) -> str:
        """Why the laser does not confirm the pose; '' if it does, or if no wall is in range."""
        if match is not None or scan.is_blind:
            return scan.blind_reason
        sparse_reason = few_beams_reason(scan) or self._sparse_reason(scan, points)
        if sparse_reason or self._is_lost:
            return sparse_reason
        covariance = self._uncertainty.since_match
        misses = misses_walls(scan, self._map.map, self._pose, covariance)
        return _NO_RETURNS if misses else ''

    def _sparse_reason(self, scan: Scan, points: Array) -> str:
        """Why walls in range do not confirm a pose that no scan has confirmed; '' if they may.

        Behind a room, in a hall with isolated posts, the pose is one that scans have confirmed.
        """
        has_confirmed = not self.config.is_mapping or bool(self.keyframes)
        hits = int(np.count_nonzero(scan.hit))
        is_sparse = len(points) < MIN_POINTS <= hits
        if not is_sparse or (has_confirmed and not self._tracking.is_delocalized):
            return ''
        return (
            f'{hits} returns, {len(points)} of them side by side on a surface: '
            f'expected at least {MIN_POINTS}'
        )

    def _update(
        self, match: Match | None, prediction: Prediction, is_stationary: bool
    ) -> Match | None:
        """Set the pose to that of an accepted match, or else to the predicted one.

        Returns the accepted match if it fits.
        """
        prior = prediction.T_map_base
        is_unexpected = match is not None and self._uncertainty.is_unexpected(match, prior)
        accepted = match is not None and not self._is_rejected(match, is_unexpected)
        # After set_pose an innovation is due to the given pose, and not to the odometry.
        if match is not None and is_unexpected and not self._tracking.is_delocalized:
            self._prediction.contradict(prediction, match, accepted)
        if match is None or not accepted:
            self._pose = prior
            self._uncertainty.coast(prior, prediction.covariance, is_stationary)
            return None
        self._pose = match.T_map_base
        fits = match.inlier_ratio >= self.config.matching.min_inlier_ratio
        self._uncertainty.update(match, prior, prediction.covariance, fits, is_stationary)
        if fits:
            self._prediction.update(prediction, match, self._systematic())
        return match if fits else None

    def _is_rejected(self, match: Match, is_unexpected: bool) -> bool:
        """Whether the pose of a match is worse than the predicted one.

        An unexpected match is, if many of its points contradict the map. After scans that could
        not be matched, one that fits badly is: a few points fit somewhere within a wide prior.
        """
        if self._tracking.is_delocalized:
            return False
        if is_unexpected and (
            match.inlier_ratio < INLIERS_PER_CONTRADICTION * match.contradiction_ratio
        ):
            return True
        is_wide = self.config.matching.is_wide(self._uncertainty.since_match)
        return self._tracking.is_unconfirmed and is_wide

    def _update_map(self, scan: Scan, points: Array) -> None:
        """Add the scan to the map if the robot has moved far enough since the last update."""
        config = self.config.local_map
        moved = self._map.moved(self._pose)
        first = moved is None
        path_m = 0.0 if moved is None else math.hypot(moved[0], moved[1])
        turn = 0.0 if moved is None else abs(float(moved[2]))
        if not first and path_m < config.update_distance_m and turn < config.update_angle_rad:
            return
        if self._tracking.needs_submap:
            self._start_submap()
        self._correct_heading(scan)
        if not self._map.add_scan(points, scan.T_base_laser, self._pose):
            # No building is that large: the pose is wrong, or was.
            self._start_submap()
            self._map.add_scan(points, scan.T_base_laser, self._pose)
        # Motion errors are independent in each step. The error of a match is correlated with that
        # of the previous match as long as the same walls are observed.
        self._uncertainty.map_updated(min(1.0, path_m / _VIEW_M + turn))
        if len(points) >= MIN_POINTS and self._loops.needs_keyframe(self._pose):
            self._add_keyframe(scan, points)

    def _correct_heading(self, scan: Scan) -> None:
        """Correct the heading by the wall directions if scans agree with the map."""
        path_m = self._loops.path_m(self._pose)
        agrees = self._tracking.agrees
        derivative = np.vstack([np.zeros((2, 4)), self._systematic()[2]])
        own = Reference(float(self._random_covariance()[2, 2]), self._share(derivative))
        self._pose = self._heading.correct(scan, self._pose, self._uncertainty, path_m, agrees, own)
        self._uncertainty.move(self._pose)
        self._tracking.record_pose(self._pose, self._uncertainty.since_match)

    def _add_keyframe(self, scan: Scan, points: Array) -> None:
        """Make the scan a keyframe."""
        loops = self._loops
        anchor = loops.keyframes.anchor
        yaw = 0.0 if anchor < 0 else float(self.keyframes[anchor].T_map_base[2])
        by_calibration, covariance, jump = self._uncertainty.step_from(yaw)
        step = Step(covariance, self._share(by_calibration))
        path_m = loops.path_m(self._pose)
        # In a new submap the heading is unknown, also by multiples of 90 degrees.
        submap = loops.pieces.current
        heading = None if self._is_lost else self._heading.measured
        (error,) = heading_errors([heading], self._pose[None])
        covariance, systematic = with_heading(self._random_covariance(), self._systematic(), error)
        frame = Keyframe(scan, points, self._pose, path_m, covariance, submap, heading, systematic)
        loops.add(frame, step, jump)
        self._uncertainty.start_step()

    def _start_submap(self) -> None:
        """Start a new local map at the dead-reckoned pose.

        Dead reckoning starts at the last scan that agreed with the old map: later matches, as in a
        crowd, are not reliable.
        """
        dead_reckoned = self._tracking.dead_reckoned
        self._pose = dead_reckoned.T_map_base
        self._prediction.reset_segment()
        covariance = dead_reckoned.covariance + self._slip_covariance()
        self._uncertainty.start_submap(self._pose, covariance)
        self._loops.pieces.begin()
        self._map.start_submap()
        self._tracking.start_submap()

    def _close_loops(self) -> Correction | None:
        """Do one step of loop closure, and apply its correction."""
        correction = self._loops.step()
        if correction is not None:
            self._apply(correction)
        return correction

    def _apply(self, correction: Correction) -> None:
        """Apply a loop closure to the pose, and re-render the local map."""
        anchor = self._loops.keyframes.anchor
        self._prediction.reset_segment()
        self._heading.calibrate(self._prediction.calibration.smoothed())
        self._pose = correction.applied_to(anchor, self._pose)
        self._map.T_at_update = self._pose
        self._uncertainty.move(self._pose)
        self._tracking.move(correction.applied_to(anchor, self._tracking.dead_reckoned.T_map_base))
        self._map.rerender(self.keyframes, self._pose)

    def _record_pose(self, scan: Scan) -> None:
        """Store the pose of this step relative to the anchor keyframe."""
        anchor = self._loops.keyframes.anchor
        T_anchor = np.zeros(3) if anchor < 0 else self.keyframes[anchor].T_map_base
        self._path.add(scan.stamp_ns, anchor, se2.between(T_anchor, self._pose))

    def _share(self, derivative: Array) -> Systematic:
        """Share of the odometry in a relative pose of this step, by its derivative (3, 4)."""
        calibration = self._prediction.calibration
        return Systematic(derivative, calibration.parameters, calibration.spans)

    @property
    def _anchor(self) -> Keyframe | None:
        anchor = self._loops.keyframes.anchor
        return None if anchor < 0 else self.keyframes[anchor]

    def _random_covariance(self) -> Array:
        """Covariance (3, 3) of the independent errors of the pose, map frame."""
        anchor = self._anchor
        if anchor is None:
            return self._uncertainty.covariance(None, None)
        return self._uncertainty.covariance(anchor.T_map_base, anchor.covariance)

    def _systematic(self) -> Array:
        """Derivative (3, 4) of the pose by the calibration of the odometry, map frame."""
        anchor = self._anchor
        if anchor is None:
            return self._uncertainty.systematic(None, NO_DERIVATIVE)
        return self._uncertainty.systematic(anchor.T_map_base, anchor.systematic)

    def _covariance(self) -> Array:
        """Covariance (3, 3) of the pose, map frame."""
        by = self._systematic()
        total = self._random_covariance() + by @ self._prediction.calibration.covariance @ by.T
        return np.asarray(0.5 * (total + total.T))

    def _estimate(
        self, match: Match | None, correction: Correction | None, blind_reason: str
    ) -> Estimate:
        covariance = self._covariance()
        if self._is_lost:
            covariance = covariance + UNKNOWN
        return Estimate(
            self._pose,
            covariance,
            se2.compose(self._pose, se2.invert(self._prediction.T_odom_base)),
            inlier_ratio=0.0 if match is None else match.inlier_ratio,
            is_lost=self._is_lost,
            is_mapping_apart=self._loops.pieces.is_apart,
            is_contradicted=self.config.is_mapping and not self._tracking.agrees,
            blind_reason=blind_reason,
            correction=correction,
        )
