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
from thinmap_ros.core.config import parameter
from thinmap_ros.core.ekf_slam.ekf_localizer import EkfConfig
from thinmap_ros.core.ekf_slam.models import odometry_slip, odometry_variances
from thinmap_ros.core.estimate import Correction, Estimate
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.odometry import OdometryAnchor
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.active_map import ActiveMap
from thinmap_ros.core.slam.covariance import UNKNOWN, PoseUncertainty
from thinmap_ros.core.slam.graph.keyframes import Keyframe, heading_variance, turned, with_heading
from thinmap_ros.core.slam.graph.loop_closure import LoopClosure, LoopConfig
from thinmap_ros.core.slam.graph.trajectory import AnchoredPoses
from thinmap_ros.core.slam.heading import HeadingCorrection
from thinmap_ros.core.slam.matching import local_map
from thinmap_ros.core.slam.matching.occupancy_surfaces import wall_points
from thinmap_ros.core.slam.matching.scan_matcher import FEWEST_POINTS, Match, Matcher, MatcherConfig
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.slam.motion_model import MotionConfig
from thinmap_ros.core.slam.odometry_prediction import OdometryPrediction, Prediction
from thinmap_ros.core.slam.tracking import FOR_A_SLIP, Tracking

_SIGMAS = 3.0
_VIEW_M = 1.0  # after a path of this length a match errs by other points than before


@dataclass(frozen=True)
class ScanLocalizerConfig(EkfConfig, MotionConfig, MatcherConfig, LoopConfig):
    """Parameters of the localizer and of its parts."""

    map_distance_m: float = parameter(
        0.2, 'the local map learns after a path of this length, m', low=0.0, high=5.0
    )
    map_turn_rad: float = parameter(0.2, 'or after such a turn, rad', low=0.0, high=3.0)
    lost_evidence: float = parameter(
        4.0,
        'evidence against the map at which a new one begins: a sum over scans of the share of '
        'points that contradict the map, less a third of those that fit. Raise it where crowds '
        'make the robot lost, lower it to notice sooner that it was moved',
        low=0.1,
        high=1000.0,
    )


class ScanLocalizer:
    """Scan matching with a local map, keyframes and loop closure.

    Input that is not finite is refused and counted in `refused`: the robot is then taken to be
    where it was.
    """

    def __init__(self, config: ScanLocalizerConfig | None = None) -> None:
        self.config = config or ScanLocalizerConfig()
        self._matcher = Matcher(self.config)
        self._refused = 0
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next scan is the first, at the configured start."""
        config = self.config
        self._pose = se2.pose(config.start_x_m, config.start_y_m, config.start_yaw_rad)
        self._prediction = OdometryPrediction(config)
        self._uncertainty = PoseUncertainty(self._pose)
        self._tracking = Tracking(config.lost_evidence, config.match_least_fit, self._pose)
        self._map = ActiveMap(config)
        self._heading = HeadingCorrection(config)
        self._loops = LoopClosure(config, self._matcher)
        self._path = AnchoredPoses()

    @property
    def refused(self) -> int:
        """Odometry poses and poses from outside that made no sense."""
        return self._refused + self._prediction.refused

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
            self._refused += 1
            return
        self._pose = se2.pose(*T_map_base.tolist())
        self._uncertainty.place(self._pose, covariance)
        self._prediction.interrupt()
        self._tracking.place(self._pose, self._uncertainty.since_fit)
        self._map.rerender(self.keyframes, self._pose)

    def state(self) -> dict[str, NDArray[Any]]:
        """The local map as arrays by name, for `from_state`; not where the robot is."""
        return self._map.map.state()

    @staticmethod
    def from_state(
        state: Mapping[str, NDArray[Any]], config: ScanLocalizerConfig | None = None
    ) -> 'ScanLocalizer':
        """ScanLocalizer in the map of another one's `state`, at the configured start.

        It is lost until scans fit there. Raises InputError where it is no such state.
        """
        checked = snapshot.validate(state, local_map.FIELDS, 'local map')
        possible = bool((checked['hits'] <= checked['seen']).all())
        snapshot.require(
            possible, 'local map: hits: more than seen', 'no more hits than observations'
        )
        localizer = ScanLocalizer(config)
        localizer._map.map.restore(checked)
        localizer._begin_in(checked)
        return localizer

    @staticmethod
    def resumed(
        patch: GridPatch,
        last: OdometryAnchor,
        T_odom_base: Array,
        config: ScanLocalizerConfig | None = None,
    ) -> 'ScanLocalizer':
        """ScanLocalizer that goes on in an occupancy map, at T_odom_base (3,) after its last pose.

        The pose is known to the noise of the odometry since then, and to a cell of the map (at a
        metre, for the heading).
        """
        localizer = ScanLocalizer(config)
        for faces in wall_points(patch):
            localizer._map.map.add_walls(faces.points, faces.normal)
        localizer._begin_in(localizer._map.map.state())
        moved = se2.between(last.T_odom_base, T_odom_base)
        turn = float(last.T_map_odom[2] + last.T_odom_base[2])
        variances = odometry_variances(moved, localizer.config)
        cell = np.full(3, patch.frame.resolution)
        localizer.set_pose(
            se2.compose(last.T_map_odom, T_odom_base),
            turned(np.diag(variances), turn) + np.diag(np.square(cell)),
        )
        return localizer

    def step(self, scan: Scan, T_odom_base: Array) -> Estimate:
        """Locate a scan with the odometry pose (3,) at its stamp, and learn from it."""
        prediction = self._prediction.predict(scan, T_odom_base, self._pose)
        stands = self._stands(prediction)
        self._uncertainty.predict(self._pose, prediction.T_map_base, prediction.covariance, stands)
        points = surface_points(scan, self.config.match_range_m)
        match = self._match(scan, points, prediction.T_map_base)
        self._tracking.reckoned = self._tracking.reckoned.moved(prediction)
        self._tracking.judge(match)
        self._update(match, prediction, stands)
        self._tracking.note(self._pose, self._uncertainty.since_fit)
        if self.config.mapping and not self._tracking.is_unplaced:
            self._learn(scan, points)
        correction = self._loops.work()
        if correction is not None:
            self._apply(correction)
        self._map.render(self.keyframes)
        self._note(scan)
        return self._estimate(match, correction)

    def corrected_path(self) -> Array:
        """Poses (N, 3) of all steps since the beginning, as they look after all corrections."""
        return self._path.poses(self._loops.finish())

    def past(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (N,) and poses (N, 3), as known now, of scans along the whole path.

        All others go with those before.
        """
        return self._loops.keyframes.path()

    def _begin_in(self, given: Mapping[str, NDArray[Any]]) -> None:
        """The local map was given: the robot is lost in it until scans fit."""
        self._map.begin_in(given)
        self._tracking.begin_in_map()
        self._uncertainty.since_fit = self._slip_covariance()

    def _slip_covariance(self) -> Array:
        """Covariance (3, 3) of a pose after wheels have slipped as far as they ever do."""
        config = self.config
        return np.diag(
            np.square(_SIGMAS * np.array([config.slip_m, config.slip_m, config.slip_rad]))
        )

    def _stands(self, prediction: Prediction) -> bool:
        """Whether the robot has not moved by more than odometry errs by."""
        slip = _SIGMAS * odometry_slip(self.config)
        is_still = self._uncertainty.stands(prediction.T_map_base, slip)
        return prediction.motion.stands and is_still

    def _match(self, scan: Scan, points: Array, prior: Array) -> Match | None:
        """The match of a scan with the local map; None where there is nothing to match."""
        if len(points) < FEWEST_POINTS or self._map.map.is_empty:
            return None
        if np.ptp(points[:, :2], axis=0).max() < self.config.match_cell_m:
            return None  # all in one place: they tell no pose
        covariance = self._uncertainty.since_fit
        return self._matcher.match(points, scan.T_base_laser, self._map.map, prior, covariance)

    def _update(self, match: Match | None, prediction: Prediction, stands: bool) -> None:
        """The pose by a match, or by the motion where there is none that can be believed."""
        prior = prediction.T_map_base
        is_unexpected = match is not None and self._uncertainty.is_unexpected(match, prior)
        accepted = match is not None and not (is_unexpected and self._is_chance(match))
        # Of a robot that was put somewhere: where it was before says nothing.
        if match is not None and is_unexpected and not self._tracking.is_unplaced:
            self._prediction.contradict(prediction, match, accepted)
        if match is None or not accepted:
            self._pose = prior
            self._uncertainty.coast(prior, prediction.covariance, stands)
            return
        self._pose = match.T_map_base
        fits = match.fit >= self.config.match_least_fit
        if fits:
            self._prediction.learn(prediction, match)
        self._uncertainty.update(match, prior, prediction.covariance, fits, stands)

    def _is_chance(self, match: Match) -> bool:
        """Whether many points contradict the map, so that a match may be chance."""
        return match.fit < FOR_A_SLIP * match.contradicted and not self._tracking.is_unplaced

    def _learn(self, scan: Scan, points: Array) -> None:
        """Extend the map by the scan, if the robot has moved since it last grew."""
        config = self.config
        moved = self._map.moved(self._pose)
        first = moved is None
        path_m = 0.0 if moved is None else math.hypot(moved[0], moved[1])
        turn = 0.0 if moved is None else abs(float(moved[2]))
        if not first and path_m < config.map_distance_m and turn < config.map_turn_rad:
            return
        self._tracking.travel(path_m)
        if self._tracking.needs_new_map:
            self._begin_submap()
        self._correct_heading(scan)
        self._map.add_scan(points, scan.T_base_laser, self._pose)
        # What the motion leaves is new with every step; what the scan leaves is much the same error
        # as in the step before, as long as the same walls are seen.
        self._uncertainty.learn(min(1.0, path_m / _VIEW_M + turn))
        if len(points) >= FEWEST_POINTS and self._loops.is_due(self._pose):
            self._keep(scan, points)

    def _correct_heading(self, scan: Scan) -> None:
        """Correct the heading by the directions of walls, where scans agree with the map."""
        path_m = self._loops.path_m(self._pose)
        agrees = self._tracking.agrees
        self._pose = self._heading.correct(scan, self._pose, self._uncertainty, path_m, agrees)
        self._uncertainty.move(self._pose)
        self._tracking.note(self._pose, self._uncertainty.since_fit)

    def _keep(self, scan: Scan, points: Array) -> None:
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
        self._uncertainty.begin_step()

    def _begin_submap(self) -> None:
        """Go on in a new local map: where the robot is in the old one is not known any more.

        The new one lies where the motion has led since a scan agreed with the old one: the matches
        since then were with what contradicts them, as in a crowd.
        """
        reckoned = self._tracking.reckoned
        self._pose = reckoned.T_map_base
        self._prediction.interrupt()
        covariance = reckoned.covariance + self._slip_covariance()
        self._uncertainty.begin_map(self._pose, covariance)
        self._map.begin_submap()
        self._tracking.begin_submap()

    def _apply(self, correction: Correction) -> None:
        """A loop was closed: pose and local map go where the keyframes have gone."""
        anchor = self._loops.keyframes.anchor
        self._prediction.interrupt()
        self._pose = correction.applied_to(anchor, self._pose)
        self._map.T_learned = self._pose
        self._uncertainty.move(self._pose)
        self._tracking.join(correction.applied_to(anchor, self._tracking.reckoned.T_map_base))
        self._map.rerender(self.keyframes, self._pose)

    def _note(self, scan: Scan) -> None:
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
            inlier_ratio=0.0 if match is None else match.fit,
            is_lost=self._tracking.is_lost,
            correction=correction,
        )
