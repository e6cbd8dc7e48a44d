"""The localizer: one step for each scan, live and offline.

A scan is matched with the local map from where the calibrated odometry expects it. The local map
grows where the robot moves; keyframes and loop closure keep the whole consistent. A robot whose
scans contradict the map goes on in a new local map, which hangs on the old one by a step as
uncertain as it is.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import parameter, part
from thinmap_ros.core.ekf_slam.ekf_localizer import EkfConfig
from thinmap_ros.core.ekf_slam.models import odometry_slip, odometry_variances
from thinmap_ros.core.estimate import Correction, Estimate
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.odometry import OdometryAnchor
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.active_map import ActiveMap
from thinmap_ros.core.slam.covariance import UNKNOWN, PoseUncertainty
from thinmap_ros.core.slam.graph.keyframes import (
    Keyframe,
    KeyframeConfig,
    heading_variance,
    rotated_covariance,
    with_heading,
)
from thinmap_ros.core.slam.graph.loop_closure import LoopClosure, LoopClosureConfig
from thinmap_ros.core.slam.graph.trajectory import KeyframeTrajectory
from thinmap_ros.core.slam.heading import HeadingCorrection
from thinmap_ros.core.slam.matching import local_map
from thinmap_ros.core.slam.matching.local_map import LocalMapConfig
from thinmap_ros.core.slam.matching.occupancy_surfaces import occupied_surface_points
from thinmap_ros.core.slam.matching.scan_matcher import (
    FEWEST_POINTS,
    Match,
    Matcher,
    MatchingConfig,
)
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.slam.motion_model import MotionConfig
from thinmap_ros.core.slam.odometry_prediction import OdometryPrediction, Prediction
from thinmap_ros.core.slam.tracking import FOR_A_SLIP, Tracking

_SIGMAS = 3.0
_VIEW_M = 1.0  # after a path of this length a match errs by other points than before


@dataclass(frozen=True)
class LocalizerConfig(EkfConfig):
    """Parameters of the localizer and of its parts."""

    lost_threshold: float = parameter(
        4.0,
        'Evidence against the map at which the robot is lost and a new submap begins: the sum over '
        'scans of the ratio of points that contradict the map, minus a third of the inlier ratio. '
        'Raise it in crowded places, lower it to detect a kidnapped robot earlier.',
        low=0.1,
        high=1000.0,
    )
    odometry: MotionConfig = part(MotionConfig)
    matching: MatchingConfig = part(MatchingConfig)
    local_map: LocalMapConfig = part(LocalMapConfig)
    keyframes: KeyframeConfig = part(KeyframeConfig)
    loop_closure: LoopClosureConfig = part(LoopClosureConfig)


class Localizer:
    """Scan matching with a local map, keyframes and loop closure.

    Input that is not finite is rejected and counted in `rejected`: the robot is then taken to be
    where it was.
    """

    def __init__(self, config: LocalizerConfig | None = None) -> None:
        self.config = config or LocalizerConfig()
        self._matcher = Matcher(self.config.matching)
        self._rejected = 0
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next scan is the first, at the configured start."""
        config = self.config
        self._pose = se2.pose(config.initial_x_m, config.initial_y_m, config.initial_yaw_rad)
        self._prediction = OdometryPrediction(config.odometry)
        self._uncertainty = PoseUncertainty(self._pose)
        self._tracking = Tracking(
            config.lost_threshold, config.matching.min_inlier_ratio, self._pose
        )
        self._map = ActiveMap(config.local_map)
        self._heading = HeadingCorrection(config.lines)
        self._loops = LoopClosure(
            config.loop_closure, config.keyframes, config.matching, config.local_map
        )
        self._path = KeyframeTrajectory()

    @property
    def rejected(self) -> int:
        """Odometry poses and poses from outside that made no sense."""
        return self._rejected + self._prediction.rejected

    @property
    def pose(self) -> Array:
        """Where the robot is, T_map_base (3,)."""
        return self._pose.copy()

    @property
    def keyframes(self) -> list[Keyframe]:
        """The scans that were kept, at their poses as they are known now."""
        return self._loops.keyframes.frames

    def set_pose(self, T_map_base: Array, covariance: Array) -> None:
        """Put the robot at a pose (3,) with covariance (3, 3) in the map that it has.

        The next scans settle it; nothing is learned before.
        """
        if not (se2.is_bounded_pose(T_map_base) and np.isfinite(covariance).all()):
            self._rejected += 1
            return
        self._pose = se2.pose(*T_map_base.tolist())
        self._uncertainty.place(self._pose, covariance)
        self._prediction.reset_segment()
        self._tracking.place(self._pose, self._uncertainty.since_match)
        self._map.rerender(self.keyframes, self._pose)

    def state(self) -> dict[str, NDArray[Any]]:
        """The local map as arrays by name, for `from_state`; not where the robot is."""
        return self._map.map.state()

    @staticmethod
    def from_state(
        state: Mapping[str, NDArray[Any]], config: LocalizerConfig | None = None
    ) -> 'Localizer':
        """Localizer in the map of another one's `state`, at the configured start.

        It is lost until scans fit there. Raises InputError where it is no such state.
        """
        checked = snapshot.validate(state, local_map.FIELDS, 'local map')
        possible = bool((checked['hits'] <= checked['seen']).all())
        snapshot.require(
            possible, 'local map: hits: more than seen', 'no more hits than observations'
        )
        localizer = Localizer(config)
        localizer._map.map.restore(checked)
        localizer._start_delocalized(checked)
        return localizer

    @staticmethod
    def from_occupancy_map(
        patch: GridPatch,
        last: OdometryAnchor,
        T_odom_base: Array,
        config: LocalizerConfig | None = None,
    ) -> 'Localizer':
        """Localizer that goes on in an occupancy map, at T_odom_base (3,) after its last pose.

        The pose is known to the noise of the odometry since then, and to a cell of the map (at a
        metre, for the heading).
        """
        localizer = Localizer(config)
        for faces in occupied_surface_points(patch):
            localizer._map.map.add_walls(faces.points, faces.normal)
        localizer._start_delocalized(localizer._map.map.state())
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
        """Locate a scan with the odometry pose (3,) at its stamp, and learn from it."""
        prediction = self._prediction.predict(scan, T_odom_base, self._pose)
        is_stationary = self._is_stationary(prediction)
        self._uncertainty.predict(
            self._pose, prediction.T_map_base, prediction.covariance, is_stationary
        )
        points = surface_points(scan, self.config.matching.max_range_m)
        match = self._match(scan, points, prediction.T_map_base)
        self._tracking.dead_reckoned = self._tracking.dead_reckoned.moved(prediction)
        self._tracking.update(match)
        self._update(match, prediction, is_stationary)
        self._tracking.record_pose(self._pose, self._uncertainty.since_match)
        if self.config.update_map and not self._tracking.is_delocalized:
            self._update_map(scan, points)
        correction = self._loops.step()
        if correction is not None:
            self._apply(correction)
        self._map.render(self.keyframes)
        self._record_pose(scan)
        return self._estimate(match, correction)

    def optimized_trajectory(self) -> Array:
        """Poses (N, 3) of all steps since the beginning, as they look after all corrections."""
        return self._path.poses(self._loops.finish())

    def keyframe_trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (N,) and poses (N, 3), as known now, of scans along the whole path.

        All others go with those before.
        """
        return self._loops.keyframes.path()

    def _start_delocalized(self, given: Mapping[str, NDArray[Any]]) -> None:
        """The local map was given: the robot is lost in it until scans fit."""
        self._map.load(given)
        self._tracking.start_delocalized()
        self._uncertainty.since_match = self._slip_covariance()

    def _slip_covariance(self) -> Array:
        """Covariance (3, 3) of a pose after wheels have slipped as far as they ever do."""
        config = self.config.matching
        slip = np.array([*[config.wheel_slip_m] * 2, config.wheel_slip_rad])
        return np.diag(np.square(_SIGMAS * slip))

    def _is_stationary(self, prediction: Prediction) -> bool:
        """Whether the robot has not moved by more than odometry errs by."""
        slip = _SIGMAS * odometry_slip(self.config.odometry)
        is_still = self._uncertainty.is_stationary(prediction.T_map_base, slip)
        return prediction.motion.is_stationary and is_still

    def _match(self, scan: Scan, points: Array, prior: Array) -> Match | None:
        """The match of a scan with the local map; None where there is nothing to match."""
        if len(points) < FEWEST_POINTS or self._map.map.is_empty:
            return None
        if np.ptp(points[:, :2], axis=0).max() < self.config.local_map.resolution_m:
            return None  # all in one place: they tell no pose
        covariance = self._uncertainty.since_match
        return self._matcher.match(points, scan.T_base_laser, self._map.map, prior, covariance)

    def _update(self, match: Match | None, prediction: Prediction, is_stationary: bool) -> None:
        """The pose by a match, or by the motion where there is none that can be believed."""
        prior = prediction.T_map_base
        is_unexpected = match is not None and self._uncertainty.is_unexpected(match, prior)
        accepted = match is not None and not (is_unexpected and self._is_rejected(match))
        # Of a robot that was put somewhere: where it was before says nothing.
        if match is not None and is_unexpected and not self._tracking.is_delocalized:
            self._prediction.contradict(prediction, match, accepted)
        if match is None or not accepted:
            self._pose = prior
            self._uncertainty.coast(prior, prediction.covariance, is_stationary)
            return
        self._pose = match.T_map_base
        fits = match.inlier_ratio >= self.config.matching.min_inlier_ratio
        if fits:
            self._prediction.update(prediction, match)
        self._uncertainty.update(match, prior, prediction.covariance, fits, is_stationary)

    def _is_rejected(self, match: Match) -> bool:
        """Whether many points contradict the map, so that a match may be chance."""
        return (
            match.inlier_ratio < FOR_A_SLIP * match.contradiction_ratio
            and not self._tracking.is_delocalized
        )

    def _update_map(self, scan: Scan, points: Array) -> None:
        """Extend the map by the scan, if the robot has moved since it last grew."""
        config = self.config.local_map
        moved = self._map.moved(self._pose)
        first = moved is None
        path_m = 0.0 if moved is None else math.hypot(moved[0], moved[1])
        turn = 0.0 if moved is None else abs(float(moved[2]))
        if not first and path_m < config.update_distance_m and turn < config.update_angle_rad:
            return
        self._tracking.add_path(path_m)
        if self._tracking.needs_submap:
            self._start_submap()
        self._correct_heading(scan)
        self._map.add_scan(points, scan.T_base_laser, self._pose)
        # What the motion leaves is new with every step; what the scan leaves is much the same error
        # as in the step before, as long as the same walls are seen.
        self._uncertainty.learn(min(1.0, path_m / _VIEW_M + turn))
        if len(points) >= FEWEST_POINTS and self._loops.needs_keyframe(self._pose):
            self._add_keyframe(scan, points)

    def _correct_heading(self, scan: Scan) -> None:
        """Correct the heading by the directions of walls, where scans agree with the map."""
        path_m = self._loops.path_m(self._pose)
        agrees = self._tracking.agrees
        self._pose = self._heading.correct(scan, self._pose, self._uncertainty, path_m, agrees)
        self._uncertainty.move(self._pose)
        self._tracking.record_pose(self._pose, self._uncertainty.since_match)

    def _add_keyframe(self, scan: Scan, points: Array) -> None:
        """Make the scan a keyframe."""
        loops = self._loops
        anchor = loops.keyframes.anchor
        yaw = 0.0 if anchor < 0 else float(self.keyframes[anchor].T_map_base[2])
        step, jump = self._uncertainty.step_from(yaw)
        path_m = loops.path_m(self._pose)
        # In a new local map the robot may be turned by any angle, also by a right one.
        heading = None if self._tracking.is_lost else self._heading.measured
        variance = heading_variance(heading, self._pose)
        covariance = with_heading(self._covariance(), variance)
        frame = Keyframe(scan, points, self._pose, path_m, covariance, self._map.number, heading)
        loops.add(frame, step, jump)
        self._uncertainty.start_step()

    def _start_submap(self) -> None:
        """Go on in a new local map: where the robot is in the old one is not known any more.

        The new one lies where the motion has led since a scan agreed with the old one: the matches
        since then were with what contradicts them, as in a crowd.
        """
        dead_reckoned = self._tracking.dead_reckoned
        self._pose = dead_reckoned.T_map_base
        self._prediction.reset_segment()
        covariance = dead_reckoned.covariance + self._slip_covariance()
        self._uncertainty.start_submap(self._pose, covariance)
        self._map.start_submap()
        self._tracking.start_submap()

    def _apply(self, correction: Correction) -> None:
        """A loop was closed: pose and local map go where the keyframes have gone."""
        anchor = self._loops.keyframes.anchor
        self._prediction.reset_segment()
        self._pose = correction.applied_to(anchor, self._pose)
        self._map.T_at_update = self._pose
        self._uncertainty.move(self._pose)
        self._tracking.join(correction.applied_to(anchor, self._tracking.dead_reckoned.T_map_base))
        self._map.rerender(self.keyframes, self._pose)

    def _record_pose(self, scan: Scan) -> None:
        """Keep the pose of the step, as seen from the anchor."""
        anchor = self._loops.keyframes.anchor
        T_anchor = np.zeros(3) if anchor < 0 else self.keyframes[anchor].T_map_base
        self._path.add(scan.stamp_ns, anchor, se2.between(T_anchor, self._pose))

    def _covariance(self) -> Array:
        """Covariance (3, 3) of the pose, map frame."""
        anchor = self._loops.keyframes.anchor
        if anchor < 0:
            return self._uncertainty.covariance(None, None)
        frame = self.keyframes[anchor]
        return self._uncertainty.covariance(frame.T_map_base, frame.covariance)

    def _estimate(self, match: Match | None, correction: Correction | None) -> Estimate:
        covariance = self._covariance()
        if self._tracking.is_lost:
            covariance = covariance + UNKNOWN
        return Estimate(
            self._pose,
            covariance,
            se2.compose(self._pose, se2.invert(self._prediction.T_odom_base)),
            inlier_ratio=0.0 if match is None else match.inlier_ratio,
            is_lost=self._tracking.is_lost,
            correction=correction,
        )
