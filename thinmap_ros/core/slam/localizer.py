"""The localizer before, `--core ekf`: one step for each scan, offline."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import parameter
from thinmap_ros.core.ekf_slam import feature_map
from thinmap_ros.core.ekf_slam.ekf import EkfSlam
from thinmap_ros.core.ekf_slam.ekf_ti import CompressedEkf
from thinmap_ros.core.ekf_slam.feature_map import FeatureConfig, FeatureMap
from thinmap_ros.core.ekf_slam.features import LineFeature
from thinmap_ros.core.ekf_slam.lines import LineConfig, Lines, extract_lines, no_lines
from thinmap_ros.core.ekf_slam.models import motion_jacobians, rotation
from thinmap_ros.core.estimate import Correction, Estimate
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.odometry import LastPose
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam import point_map
from thinmap_ros.core.slam.anchors import AnchoredPoses
from thinmap_ros.core.slam.doubt import Doubt, Evidence
from thinmap_ros.core.slam.loops import LEAP_SIGMAS, Keyframe, LoopConfig, Loops
from thinmap_ros.core.slam.odometry_calibration import OdometryCalibration
from thinmap_ros.core.slam.odometry_noise import OdometryNoise
from thinmap_ros.core.slam.point_map import PointMap
from thinmap_ros.core.slam.redrawn_map import RedrawnMap
from thinmap_ros.core.slam.scan_matching import FEWEST_POINTS, Match, MatchConfig
from thinmap_ros.core.slam.tracking import SEEN_AGAIN, Tracking, share_seen_again
from thinmap_ros.core.slam.wall_compass import WallCompass
from thinmap_ros.core.slam.wall_points import wall_points
from thinmap_ros.core.slam.wheel_noise import (
    MotionConfig,
    odometry_covariance,
    odometry_variances,
)
from thinmap_ros.core.snapshot import Field
from thinmap_ros.core.topology.graph import TopologicalMap

# The map begins where the robot stands: no doubt, but not singular.
_START_SIGMAS = (1e-4, 1e-4, 1e-4)
_LONGEST_STEP_M = 5.0  # between two scans the wheels cannot go farther: the odometry was set anew
# Where less of a scan than this lies on what is known, there is nothing to contradict,
_NEW_GROUND = 0.3
# and that is so only this far from where the map last learned.
_NEW_GROUND_M = 0.6
_NEW_GROUND_RAD = 0.6
_KNOWN_M, _KNOWN_RAD = 0.2, 0.2  # nearer than that, most of a scan must be known
_NO_NEWS = 0.9  # where more of a scan than this lies on what is known, it shows nothing new
# A scan puts the robot this far from where the wheels did: one of them is wrong.
_LEAP_M = 0.4
_LEAP_RAD = 0.4
_OF_LATE_M = 100.0  # way in which the drift stays below what a match with the map bridges
# By which lines may move the pose even where matches leave nothing open, m and rad, 1 sigma.
_LEEWAY = np.diag(np.square([0.003, 0.003, 0.001]))
_UNKNOWN_SIGMA_M = 300.0  # what a pose is known to while the robot is lost
# Where fewer beams hit, and not half of them, as in a wide hall, a contradiction proves nothing.
_TELLING_POINTS = 40
# Doubt of the heading (1 sigma) with which nothing is drawn while walls may tell it soon.
_UNTURNED_RAD = 0.03
_SLIP_SIGMAS = 3.0  # motion within so much of the slip is none
_USUAL_NOISE = 0.1  # share of the variances allowed for that wheels mostly have
FIELDS = {
    **feature_map.FIELDS,
    **point_map.FIELDS,
    # the share of a scan that usually fits; not in the first sessions
    'usual': Field(np.float64, (), 0.0, 1.0, optional=True),
}
# Doubt since a scan last fitted; far from the start, more than this is no reason to be lost.
_LOST_SIGMA_M = 1.0


@dataclass(frozen=True)
class LocalizerConfig(MotionConfig, MatchConfig, LineConfig, FeatureConfig, LoopConfig):
    """Parameters of the localizer and of its parts.

    slam: ti runs the filter over the line features of the local area, and full, for the same
    estimate, over all; off leaves them out, and the covariance of the pose is then what the match
    with the map of points leaves open, without the drift of that map.
    """

    slam: str = parameter(
        'ti',
        'ti: EKF over line features, local by topology; full: EKF over all; '
        'off: scan matching alone',
        choices=('ti', 'full', 'off'),
    )
    gap_m: float = parameter(
        0.3, 'seen part and feature may lie this far apart along the line, m', low=0.0, high=5.0
    )
    start_x_m: float = parameter(
        0.0, 'where the robot starts in the map, m', low=-se2.FARTHEST_M, high=se2.FARTHEST_M
    )
    start_y_m: float = parameter(
        0.0, 'where the robot starts in the map, m', low=-se2.FARTHEST_M, high=se2.FARTHEST_M
    )
    start_yaw_rad: float = parameter(0.0, 'heading at the start, rad')
    look_distance_m: float = parameter(
        0.3, 'the map learns after so much way, m', low=0.0, high=5.0
    )
    look_turn_rad: float = parameter(0.2, 'or after such a turn, rad', low=0.0, high=3.0)
    square_walls: bool = parameter(
        True,
        'hold the heading to the direction of the walls, '
        'where most stand parallel or square to each other',
    )
    mapping: bool = parameter(
        True, 'learn what is seen; false: only find the place in the map that there is'
    )
    lost_scans: int = parameter(
        5, 'lost after so many scans in a row that do not fit', low=1, high=1000
    )


class Localizer:
    """Line-feature EKF-SLAM; predicts by odometry, sharpened by matching scan and map of points.

    Source: EKF-SLAM/TI paper section 2. Input that is not finite is refused and counted in
    `refused`: the robot is then taken to be where it was.
    """

    def __init__(self, config: LocalizerConfig | None = None) -> None:
        self.config = config or LocalizerConfig()
        self.refused = 0
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next scan is the first, at the configured start."""
        start = se2.pose(self.config.start_x_m, self.config.start_y_m, self.config.start_yaw_rad)
        self._filter = CompressedEkf(start, np.diag(np.square(_START_SIGMAS)))
        self._feature_map = FeatureMap(self.config, local_areas=self.config.slam == 'ti')
        self._map = RedrawnMap(self.config)
        self._loops = Loops(self.config, self.config)
        self._path = AnchoredPoses()  # of every step
        self._T_odom_base: Array | None = None
        self._T_odom_moved: Array = np.zeros(3)  # when odometry last said that the robot moved
        self._stands = False
        self._calibration = OdometryCalibration()
        self._noise = OdometryNoise(self.config)
        # Information of the last match that was good, as the map alone tells it.
        self._by_map = np.zeros((3, 3))
        self._T_last_look: Array | None = None
        self._points_last_look: Array = np.empty((0, 2))
        # Share of that look's points which the map then knew;
        # walls that are far off take several looks.
        self._known_here = 0.0
        self._compass = WallCompass()
        self._doubt = Doubt()
        self._blind: Array = np.zeros(3)  # doubt since the last look, where scans told nothing
        self._placed_by_hand = False
        self._tracking = Tracking(self.config.lost_scans)

    def set_pose(self, T_map_base: Array, covariance: Array) -> None:
        """Put the robot at a pose (3,) with covariance (3, 3) in the map that it has.

        The next scans settle it.
        """
        if not (se2.is_on_earth(T_map_base) and np.isfinite(covariance).all()):
            self.refused += 1
            return
        floor = np.diag(np.square(_START_SIGMAS))
        self._ekf.set_pose(T_map_base, covariance + floor)
        self._doubt = Doubt(covariance + floor)
        self._placed_by_hand = True
        self._tracking.found()
        self._calibration.interrupt()

    def state(self) -> dict[str, NDArray[Any]]:
        """The features and the map of points as arrays by name, for `from_state`.

        Not where the robot is.
        """
        usual = np.array(self._tracking.usual)
        return {
            **self._feature_map.state(self._filter),
            **self._map.matcher.map.state(),
            'usual': usual,
        }

    @staticmethod
    def from_state(
        state: Mapping[str, NDArray[Any]], config: LocalizerConfig | None = None
    ) -> 'Localizer':
        """Localizer in the map of another one's `state`, at the configured start.

        It is lost until a scan fits there. The map of points that was given stays as it is where
        loops are closed later. Raises InputError where it is no such state.
        """
        checked = snapshot.check(state, FIELDS, 'features')
        localizer = Localizer(config)
        localizer._map = RedrawnMap(localizer.config, checked)
        localizer._feature_map.restore(localizer._filter, checked)
        usual = float(checked.get('usual', np.ones(())))
        localizer._tracking = Tracking(localizer.config.lost_scans, usual, carried=True)
        return localizer

    @staticmethod
    def resumed(
        patch: GridPatch, last: LastPose, T_odom_base: Array, config: LocalizerConfig | None = None
    ) -> 'Localizer':
        """Localizer that goes on in an occupancy map, at T_odom_base (3,) after its last pose.

        Scans are matched with the walls of the map before anything is drawn. The pose is known to
        the noise of the odometry since then, and to a cell of the map (at a metre, for the
        heading).
        """
        localizer = Localizer(config)
        points = PointMap(localizer.config.match_cell_m, localizer.config.match_memory)
        for faces in wall_points(patch):
            points.add(*faces)
        localizer._map = RedrawnMap(localizer.config, points.state())
        moved = se2.between(last.T_odom_base, T_odom_base)
        turn = rotation(float(last.T_map_odom[2] + last.T_odom_base[2]))
        covariance = turn @ odometry_covariance(moved, localizer.config) @ turn.T
        cell = np.full(3, patch.frame.resolution)
        localizer.set_pose(
            se2.compose(last.T_map_odom, T_odom_base), covariance + np.diag(np.square(cell))
        )
        return localizer

    @property
    def pose(self) -> Array:
        """Where the robot is, T_map_base (3,)."""
        return self._ekf.pose

    @property
    def features(self) -> list[LineFeature]:
        """The line features of the map."""
        return self._feature_map.listed(self._filter)

    @property
    def _ekf(self) -> EkfSlam:
        """The filter of the pose and the local features."""
        return self._filter.local

    def set_topology(self, topology: TopologicalMap) -> None:
        """Take the topological map by which features are stored.

        Until one is known, the robot's own way serves.
        """
        self._feature_map.area.set_topology(topology)

    def step(self, scan: Scan, T_odom_base: Array) -> Estimate:
        """Take in a scan with the odometry pose (3,) at its stamp."""
        increment, increment_covariance = self._odometry(T_odom_base)
        points_base, laser_base = self._seen(scan)
        expected = se2.compose(self._ekf.pose, increment)
        way_m = self._loops.way_m(self._ekf.pose)
        points = self._map.matcher.map
        points.way_m = way_m
        # Until it is known that old and new agree here, a scan is matched with what was seen of
        # late.
        points.since_m = -math.inf if self._loops.agreed else way_m - _OF_LATE_M
        looks, matched = self.config.mapping and self._has_news(expected), 0
        lines = self._lines(scan) if looks else no_lines()
        match = self._predict(scan, lines, points_base, laser_base, increment, increment_covariance)
        if looks and not self._is_unplaced():
            laser_map = se2.transform_points(self._ekf.pose, laser_base[None])[0]
            matched = self._correct(lines, scan)
            if match.good or (
                self._on_new_ground(match, scan, self._ekf.pose)
                and self._may_draw(points_base, scan)
            ):
                self._compass.learn(lines, float(self._ekf.pose[2]), way_m)
                points_map = se2.transform_points(self._ekf.pose, points_base)
                self._map.matcher.add(points_map, laser_map)
                self._known_here = self._map.matcher.known(points_base, laser_base, self._ekf.pose)
                self._T_last_look, self._points_last_look = self._ekf.pose, points_base
                leap = LEAP_SIGMAS if _is_leap(expected, self._ekf.pose) else np.zeros(3)
                doubt, self._blind = np.maximum(leap, self._blind), np.zeros(3)
                self._loops.follow(
                    scan, points_base, self._ekf.pose, doubt, match.overlap < _NO_NEWS
                )
        elif match.good and not self.config.mapping:
            self._T_last_look, self._points_last_look = self._ekf.pose, points_base
        self._filter.work_off()
        self._loops.work_off()
        correction = self._loops.close()
        if match.good:
            self._calibration.follow(self._ekf.pose, self._by_map)
        if correction is not None:
            self._apply(correction, points_base)
            self._calibration.interrupt()
        pose, k = self._ekf.pose, self._loops.anchor
        self._map.go_on(self._loops.keyframes, pose)
        self._path.add(
            scan.stamp_ns,
            k,
            pose if k < 0 else se2.between(self._loops.keyframes[k].T_map_base, pose),
        )
        return self._estimate(match, lines, matched, correction)

    def corrected_path(self) -> Array:
        """Poses (N, 3) of all steps since the beginning, as they look after all corrections."""
        return self._path.poses(self._loops.relaxed())

    def past(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (N,) and poses (N, 3), as known now, of scans along the whole way.

        All others go with those before.
        """
        return self._loops.past()

    @property
    def keyframes(self) -> list[Keyframe]:
        """The scans that were kept, at their poses as they are known now."""
        return self._loops.keyframes

    def _apply(self, correction: Correction, points_base: Array) -> None:
        """A loop was closed: pose, features and the map of points go where the keyframes have gone.

        points_base (N, 2): of the scan just made, which is what was seen last where the robot is
        now.
        """
        moved = correction.moved(self._loops.anchor, self._ekf.pose)
        self._feature_map.move(self._filter, correction)
        self._ekf.move_pose(moved)
        self._T_last_look, self._points_last_look = moved, points_base
        self._map.begin_anew(self._loops.keyframes, moved)

    def _odometry(self, T_odom_base: Array) -> tuple[Array, Array]:
        """Input u of eq. (10): increment (3,) since the last scan, and its covariance (3, 3)."""
        last, increment = self._T_odom_base, np.zeros(3)
        since_it_moved: Array | None = None
        if se2.is_finite(T_odom_base):
            self._T_odom_base = np.array(T_odom_base, dtype=np.float64)
            if last is None:
                self._T_odom_moved = self._T_odom_base
                return increment, np.diag(np.square(_START_SIGMAS))
            increment = se2.between(last, self._T_odom_base)
            moved = se2.between(self._T_odom_moved, self._T_odom_base)
            since_it_moved = moved if self._stands else None
            self._stands = self._within_slip(moved)
            if not self._stands:
                self._T_odom_moved = self._T_odom_base
        if (
            not se2.is_finite(T_odom_base)
            or math.hypot(increment[0], increment[1]) > _LONGEST_STEP_M
        ):
            self.refused += 1
            increment = np.zeros(3)
            since_it_moved = None
        variances = _USUAL_NOISE * odometry_variances(increment, self.config)
        increment, systematic = self._calibration.corrected(increment, variances)
        self._noise.move(increment)
        # Of a robot that stood, what it crept meanwhile was not counted yet.
        counted = increment if since_it_moved is None else since_it_moved
        return increment, odometry_covariance(counted, self.config, self._noise.share) + systematic

    def _within_slip(self, moved: Array) -> bool:
        """Whether a motion (3,) is no more than the error of any increment: 3 sigmas of the slip.

        An odometry that trembles adds nothing then, and one that creeps counts as soon as it has
        come that far.
        """
        slip = np.array(
            [self.config.odom_slip_m, self.config.odom_slip_m, self.config.odom_slip_rad]
        )
        return bool((np.abs(moved) <= _SLIP_SIGMAS * slip).all())

    def _seen(self, scan: Scan) -> tuple[Array, Array]:
        """Points (N, 2) that can be matched and the laser's place (2,), robot frame."""
        if not se2.is_finite(scan.T_base_laser):
            self.refused += 1
            return np.empty((0, 2)), np.zeros(2)
        near = scan.ranges_m[scan.hit] < self.config.match_range_m
        laser_base = np.ascontiguousarray(scan.T_base_laser[:2])
        return np.ascontiguousarray(scan.points_base()[near]), laser_base

    def _predict(
        self,
        scan: Scan,
        lines: Lines,
        points_base: Array,
        laser_base: Array,
        increment: Array,
        covariance: Array,
    ) -> Match:
        """Eqs. (10), (11) with the increment of the odometry.

        Where the scan fits the map, with that of the match.
        """
        pose = self._ekf.pose
        turn = rotation(float(pose[2]))
        predicted = se2.compose(pose, increment)
        F, _ = motion_jacobians(pose, increment)
        self._blind = np.maximum(self._blind, _blind(self._doubt.since_match, self._noise))
        since_match = self._doubt.since_match
        on_map = self._doubt.on_map
        self._doubt.move(F, turn @ covariance @ turn.T)
        if self.config.square_walls and len(lines) and not self._is_unplaced():
            predicted = self._turned_by_walls(lines, predicted)
            increment = se2.between(pose, predicted)
        match = self._map.matcher.match(
            points_base, laser_base, predicted, self._doubt.since_match, lost=self._tracking.lost
        )
        near = not self._moved(_KNOWN_M, _KNOWN_RAD, match.T_map_base)
        match = self._tracking.judged(match, points_base, scan, increment, near)
        enough = max(FEWEST_POINTS, min(_TELLING_POINTS, scan.ranges_m.size // 2))
        if match.good or len(points_base) >= enough:
            self._tracking.count(match.good, self._on_new_ground(match, scan, predicted))
        if match.good:
            off = se2.off(match.T_map_base, predicted)
            evidence = self._doubt.evidence(match.covariance, off)
            # Wheels may be stuck, or the robot pushed: then the walls tell that it moves.
            stands = self._stands and self._within_slip(off)
            if not stands:
                self._noise.learn(off, evidence, float(predicted[2]))
            self._by_map = evidence.by_map
            match = self._taken_back(match, predicted, evidence)
            added = self._doubt.match(evidence, increment)
            if stands:
                # The same look at the same walls: neither an error more nor a proof more.
                self._doubt.on_map = on_map
                added = np.zeros((3, 3))
            # Of a robot that stands, the jitter of the matches is no motion,
            # and carries nothing on.
            increment = np.zeros(3) if stands else se2.between(pose, match.T_map_base)
            covariance = turn.T @ added @ turn
            predicted = match.T_map_base
        elif self._stands:
            self._doubt = Doubt(on_map)
            self._doubt.since_match = since_match
            covariance = np.zeros((3, 3))
        if match.good and (
            self._placed_by_hand or self.config.slam == 'off' or not self.config.mapping
        ):
            self._ekf.set_pose(match.T_map_base, match.covariance)
            self._placed_by_hand = False
        else:
            self._ekf.predict(predicted, increment, covariance)
        return match

    def _turned_by_walls(self, lines: Lines, predicted: Array) -> Array:
        """A pose (3,) after the lines of the scan have told what they know of the heading.

        The doubt of it changes, too.
        """
        P = self._doubt.since_match
        told = self._compass.read(lines, float(predicted[2]), float(P[2, 2]))
        if told is None:
            return predicted
        gain = P[:, 2] / (P[2, 2] + told.variance)
        self._doubt.since_match = P - np.outer(gain, P[2])
        self._blind[2] = min(self._blind[2], math.sqrt(self._doubt.since_match[2, 2]))
        return se2.pose(*(predicted + gain * (told.yaw - predicted[2])).tolist())

    def _taken_back(self, match: Match, predicted: Array, evidence: Evidence) -> Match:
        """A match that takes back what lines did to the pose takes it back whole.

        That is, in features and open directions, too. The map of points is as it was, so the match
        leads back to it. If that passed for motion, each look would do it again, and the pose would
        creep wherever points say nothing: along a corridor, by its own two walls.
        """
        step, seen = self._ekf.moved_by_updates(), evidence.by_map
        off = se2.off(match.T_map_base, predicted)
        share = float(
            np.clip(-(off @ seen @ step) / max(float(step @ seen @ step), 1e-12), 0.0, 1.0)
        )
        self._ekf.take_back(share)
        T_map_base = match.T_map_base - share * (evidence.posterior @ evidence.by_prior @ step)
        T_map_base[2] = se2.wrap(float(T_map_base[2]))
        return replace(match, T_map_base=T_map_base)

    def _lines(self, scan: Scan) -> Lines:
        """Lines of a scan, in the robot frame."""
        used = self.config.slam != 'off' or self.config.square_walls
        wanted = used and se2.is_finite(scan.T_base_laser)
        return extract_lines(scan, self.config) if wanted else no_lines()

    def _correct(self, lines: Lines, scan: Scan) -> int:
        """Eqs. (6)-(9) with the lines of the scan; how many of them were known."""
        if self.config.slam == 'off' or not se2.is_finite(scan.T_base_laser):
            return 0
        matched, taken = self._feature_map.observe(
            self._filter, lines, scan, self._doubt.on_map + _LEEWAY
        )
        self.refused += not taken
        return matched

    def _has_news(self, T_map_base: Array) -> bool:
        """Whether the robot has moved since it last learned.

        Looks from one place err alike, and prove nothing anew.
        """
        return self._moved(self.config.look_distance_m, self.config.look_turn_rad, T_map_base)

    def _may_draw(self, points_base: Array, scan: Scan) -> bool:
        """Whether a scan on new ground is taken into the map.

        Not a first glance after a turn that is hardly known: what is drawn askew there keeps all
        that follows askew, and more of the walls soon tells the heading.
        """
        unturned = (
            self._doubt.since_match[2, 2] > _UNTURNED_RAD**2 and self._compass.direction is not None
        )
        few = 3 * len(points_base) < scan.ranges_m.size
        early = unturned and few and self.config.square_walls
        return len(points_base) >= FEWEST_POINTS and not early

    def _on_new_ground(self, match: Match, scan: Scan, T_map_base: Array) -> bool:
        """Whether the robot's place, (3,), explains that a scan lies on little that is known.

        Near the place where the map last learned, what was seen there is still to be seen, if it is
        in view at all, and unless little came of it.
        """
        if match.overlap >= _NEW_GROUND:
            return False
        last = self._T_last_look
        if (
            last is None
            or self._known_here < _NEW_GROUND
            or self._moved(_NEW_GROUND_M, _NEW_GROUND_RAD, T_map_base)
        ):
            return True
        moved = se2.between(last, T_map_base)
        return share_seen_again(self._points_last_look, moved, scan) >= SEEN_AGAIN

    def _moved(self, distance_m: float, turn_rad: float, T_map_base: Array | None = None) -> bool:
        """Whether the robot, or a pose (3,), is that far from where the map last learned."""
        if self._T_last_look is None:
            return True
        moved = se2.between(self._T_last_look, self._ekf.pose if T_map_base is None else T_map_base)
        return math.hypot(moved[0], moved[1]) >= distance_m or abs(float(moved[2])) >= turn_rad

    def _is_unplaced(self) -> bool:
        """Whether nothing may be drawn where the robot seems to be.

        Lost, or put there roughly and not yet settled.
        """
        return self._tracking.lost or (self._placed_by_hand and self._is_lost())

    def _is_lost(self) -> bool:
        in_doubt = self._doubt.since_match[[0, 1], [0, 1]].max() > _LOST_SIGMA_M**2
        return self._tracking.lost or bool(in_doubt)

    def _estimate(
        self, match: Match, lines: Lines, matched: int, correction: Correction | None
    ) -> Estimate:
        T_map_base = self._ekf.pose
        T_odom_base = np.zeros(3) if self._T_odom_base is None else self._T_odom_base
        lost, covariance = self._is_lost(), self._ekf.pose_covariance
        if lost:
            unknown = np.diag([_UNKNOWN_SIGMA_M**2, _UNKNOWN_SIGMA_M**2, math.pi**2])
            covariance = covariance + unknown
        return Estimate(
            T_map_base,
            covariance,
            se2.compose(T_map_base, se2.invert(T_odom_base)),
            len(lines),
            matched,
            len(self._feature_map),
            len(self._filter.area),
            match.fit,
            lost,
            correction,
        )


def _is_leap(expected: Array, found: Array) -> bool:
    off = se2.between(expected, found)
    return math.hypot(off[0], off[1]) > _LEAP_M or abs(float(off[2])) > _LEAP_RAD


def _blind(since_match: Array, noise: OdometryNoise) -> Array:
    """Sigmas (3,) of a pose since a scan last fitted, by wheels as good as they were so far.

    0 where that is no more than usual.
    """
    share = np.sqrt(noise.found_share / noise.share)
    largest = float(np.linalg.eigvalsh(since_match[:2, :2])[-1])
    along = float(share.max()) * math.sqrt(max(largest, 0.0))
    sigmas = np.array([along, along, share[1] * math.sqrt(since_match[2, 2])])
    return sigmas if (sigmas > LEAP_SIGMAS).any() else np.zeros(3)
