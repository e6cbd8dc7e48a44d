"""The localizer: one step for each scan, live and offline.

A scan is matched with the local map from where the calibrated odometry expects it. The local map
grows where the robot moves; keyframes and loop closure keep the whole consistent. A robot whose
scans contradict the map goes on in a new local map, which hangs on the old one by a step as
uncertain as it is.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import parameter
from thinmap_ros.core.ekf_slam import feature_map
from thinmap_ros.core.ekf_slam.features import LineFeature
from thinmap_ros.core.ekf_slam.line_map import LineMap
from thinmap_ros.core.ekf_slam.localizer import EkfConfig
from thinmap_ros.core.ekf_slam.models import odometry_slip, odometry_variances
from thinmap_ros.core.estimate import Correction, Estimate
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.odometry import LastPose, OdometryIncrements
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam import local_map
from thinmap_ros.core.slam.anchors import AnchoredPoses
from thinmap_ros.core.slam.keyframes import Keyframe, carried, inverse, turned
from thinmap_ros.core.slam.local_map import LocalMap
from thinmap_ros.core.slam.loop_closure import LoopClosure, LoopConfig
from thinmap_ros.core.slam.matcher import FEWEST_POINTS, Match, Matcher, MatcherConfig
from thinmap_ros.core.slam.motion import Motion, MotionConfig, MotionModel
from thinmap_ros.core.slam.odometry_calibration import OdometryCalibration
from thinmap_ros.core.slam.surface import surface_points
from thinmap_ros.core.slam.wall_compass import WallCompass
from thinmap_ros.core.slam.wall_points import wall_points
from thinmap_ros.core.topology.graph import TopologicalMap

_CHI2 = 11.34  # 99 % of three degrees of freedom
_VIEW_M = 1.0  # after a path of this length a match errs by other points than before
_STANDS_M = 1e-3  # odometry of a robot that stands, and a scan's worth of turning
_SIGMAS = 3.0
_FOR_A_SLIP = 3.0  # points that fit, for one that contradicts, where scan and motion disagree
_AT_ONCE = 20  # keyframes drawn at once after a correction
_A_STEP = 2  # and in each step after it
_UNKNOWN_M = 300.0  # uncertainty of a pose that could be anywhere
_ADRIFT_M = 10.0  # path in a new local map after which it is part of the map for good
# Covariance of a matched pose, as seen from walls that were seen some way back: what matching adds
# there to the error. Lines are surer of the heading, as they are long; of the place cells are.
_BESIDE_WALLS = np.diag(np.square([5e-3, 5e-3, 3e-3]))
_STEP_SIGMAS = (2e-3, 2e-3, 5e-4)  # of a step between keyframes, at least
_NEW_SHARE = 0.2  # of the error of a match, from one look to the next
FIELDS = {**feature_map.FIELDS, **local_map.FIELDS}


@dataclass(frozen=True)
class ScanLocalizerConfig(EkfConfig, MotionConfig, MatcherConfig, LoopConfig):
    """Parameters of the localizer and of its parts."""

    map_distance_m: float = parameter(
        0.2, 'the local map learns after a path of this length, m', low=0.0, high=5.0
    )
    map_turn_rad: float = parameter(0.2, 'or after such a turn, rad', low=0.0, high=3.0)
    lost_evidence: float = parameter(
        1.5,
        'lost when this many scans more contradict the map than fit it, each by its share',
        low=0.1,
        high=1000.0,
    )


@dataclass(frozen=True, eq=False)
class Reversal:
    """What the next motion takes back of one that contradicted its scan, map frame.

    mean (3,), covariance (3, 3). A reading of the odometry that was wrong is put right by the next
    one, what wheels have slipped is not; one is as likely as the other.
    """

    mean: Array = field(default_factory=lambda: np.zeros(3))
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))


def _half_squared(T_a: Array, T_b: Array) -> Array:
    """Covariance (3, 3) of a pose that is as likely at one pose (3,) as at another."""
    half = 0.5 * se2.off(T_a, T_b)
    return np.outer(half, half)


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
        self._given: Mapping[str, NDArray[Any]] | None = None
        self._map = LocalMap(config)
        self._motion = MotionModel(config)
        self._loops = LoopClosure(config, self._matcher)
        self._lines = LineMap(config, config, config.slam == 'ti')
        self._path = AnchoredPoses()
        self._odometry = OdometryIncrements()
        self._calibration = OdometryCalibration()
        self._compass = WallCompass()
        self._yaw_variance = _STEP_SIGMAS[2] ** 2  # of the heading since the compass told it
        self._T_learned: Array | None = None
        self._T_stood = self._pose  # where the robot was when it last moved
        # Covariances (3, 3), map frame: of the motion since a scan fitted, of the pose since the
        # map learned, of the place where it did since the anchor, and of contradictions on the way.
        self._since_fit = np.zeros((3, 3))
        self._since_learned = np.zeros((3, 3))
        self._since_anchor = np.zeros((3, 3))
        self._by_motion = np.zeros((3, 3))  # the part of `_since_learned` that the motion leaves
        # The part of the error of the scan that the map learned from that `_since_anchor` has not.
        self._at_learning = np.zeros((3, 3))
        self._jump = np.zeros((3, 3))
        self._reversal = Reversal()
        self._evidence = 0.0
        # Where the motion alone leads since a scan agreed with the map: pose, covariance.
        self._reckoned = (self._pose, np.zeros((3, 3)))
        self._is_unplaced = False  # in a map that was given, or put somewhere by hand
        self._adrift_m = 0.0  # path for which a new local map is not yet part of the map
        self._submap = 0
        self._due: list[int] = []

    @property
    def refused(self) -> int:
        """Odometry poses and poses from outside that made no sense."""
        return self._refused + self._odometry.refused

    @property
    def pose(self) -> Array:
        """Where the robot is, T_map_base (3,)."""
        return self._pose.copy()

    @property
    def features(self) -> list[LineFeature]:
        """The line features of the map."""
        return self._lines.features

    @property
    def keyframes(self) -> list[Keyframe]:
        """The scans that were kept, at their poses as they are known now."""
        return self._loops.keyframes.frames

    def set_topology(self, topology: TopologicalMap) -> None:
        """Take the topological map by which features are stored."""
        self._lines.set_topology(topology)

    def set_pose(self, T_map_base: Array, covariance: Array) -> None:
        """Put the robot at a pose (3,) with covariance (3, 3) in the map that it has.

        The next scans settle it; nothing is learned before.
        """
        if not (se2.is_on_earth(T_map_base) and np.isfinite(covariance).all()):
            self._refused += 1
            return
        least = np.diag(np.square(_STEP_SIGMAS))
        self._pose = se2.pose(*T_map_base.tolist())
        self._T_stood = self._pose
        self._since_fit = 0.5 * (covariance + covariance.T) + least
        self._since_anchor = np.zeros((3, 3))
        self._at_learning = np.zeros((3, 3))
        self._since_learned = self._since_fit
        self._jump = self._jump + self._since_fit + np.diag([_UNKNOWN_M**2, _UNKNOWN_M**2, 10.0])
        self._calibration.interrupt()
        self._is_unplaced = True
        self._adrift_m = 0.0
        self._evidence = 0.0
        self._reckoned = (self._pose, self._since_fit)
        self._draw_anew()

    def state(self) -> dict[str, NDArray[Any]]:
        """The features and the local map as arrays by name, for `from_state`.

        Not where the robot is.
        """
        return {**self._lines.state(), **self._map.state()}

    @staticmethod
    def from_state(
        state: Mapping[str, NDArray[Any]], config: ScanLocalizerConfig | None = None
    ) -> 'ScanLocalizer':
        """ScanLocalizer in the map of another one's `state`, at the configured start.

        It is lost until scans fit there. Raises InputError where it is no such state.
        """
        checked = snapshot.check(state, FIELDS, 'features')
        possible = bool((checked['hits'] <= checked['seen']).all())
        snapshot.require(possible, 'features: hits: more than seen', 'no more hits than looks')
        localizer = ScanLocalizer(config)
        localizer._map.restore(checked)
        localizer._lines.restore(
            {name: array for name, array in checked.items() if name in feature_map.FIELDS}
        )
        localizer._begin_in({name: checked[name] for name in local_map.FIELDS})
        return localizer

    @staticmethod
    def resumed(
        patch: GridPatch,
        last: LastPose,
        T_odom_base: Array,
        config: ScanLocalizerConfig | None = None,
    ) -> 'ScanLocalizer':
        """ScanLocalizer that goes on in an occupancy map, at T_odom_base (3,) after its last pose.

        The pose is known to the noise of the odometry since then, and to a cell of the map (at a
        metre, for the heading).
        """
        localizer = ScanLocalizer(config)
        for faces in wall_points(patch):
            localizer._map.add_walls(faces.points, faces.normal)
        localizer._begin_in(localizer._map.state())
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
        """Take in a scan with the odometry pose (3,) at its stamp."""
        motion = self._expect(scan, T_odom_base)
        points = self._points(scan)
        before = self._pose
        reversal = self._reversal
        self._reversal = Reversal()
        Q = turned(motion.covariance, float(before[2])) + reversal.covariance
        expected = se2.compose(before, motion.increment) + reversal.mean
        prior = se2.pose(*expected.tolist())
        stands = motion.stands and self._is_near(self._T_stood, prior)
        self._since_fit = carried(self._since_fit, prior[:2] - before[:2]) + Q
        if not stands:
            lever = prior[:2] - self._T_stood[:2]
            self._since_anchor = carried(self._since_anchor, lever)
            self._since_learned = carried(self._since_learned, lever)
        self._reckon(motion)
        match = self._match(scan, points, prior)
        if match is not None:
            self._judge(match)
        if match is None or self._is_refused(match, prior):
            self._pose = prior
            if match is not None:
                self._reversal = Reversal(np.zeros(3), _half_squared(match.T_map_base, prior))
            if not stands:
                self._since_learned = self._since_learned + Q
            self._by_motion = self._since_learned
        else:
            self._take(match, before, prior, Q, stands)
        if self._evidence == 0.0:
            self._reckoned = (self._pose, self._since_fit)
        if not stands:
            self._T_stood = self._pose
        self._lines.rest()
        if self.config.mapping and not self._is_unplaced:
            self._learn(scan, points)
        self._lines.work_off()
        correction = self._loops.work()
        if correction is not None:
            self._apply(correction)
        self._draw(_A_STEP)
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
        self._given = given
        self._is_unplaced = True
        self._evidence = self.config.lost_evidence
        sigma = _SIGMAS * np.array([self.config.slip_m] * 2 + [self.config.slip_rad])
        self._since_fit = np.diag(np.square(sigma))

    def _is_near(self, T_map_base: Array, other: Array) -> bool:
        """Whether two poses (3,) are no farther apart than odometry errs by in a step."""
        off = np.abs(se2.off(other, T_map_base))
        return bool((off <= _SIGMAS * odometry_slip(self.config)).all())

    def _expect(self, scan: Scan, T_odom_base: Array) -> Motion:
        """The motion since the last scan."""
        increment = self._odometry.next(scan.stamp_ns, T_odom_base)
        variances = odometry_variances(increment.T_before_base, self.config)[[0, 2]]
        moved, systematic = self._calibration.corrected(increment.T_before_base, variances)
        motion = self._motion.expect(moved, systematic)
        if increment.bound_m == 0.0:
            return motion
        self._calibration.interrupt()
        unknown = np.diag(np.square([increment.bound_m, increment.bound_m, 1.0]))
        return Motion(motion.increment, motion.covariance + unknown, False)

    def _reckon(self, motion: Motion) -> None:
        """Carry the pose that the motion alone leads to on by a step."""
        before, covariance = self._reckoned
        after = se2.compose(before, motion.increment)
        Q = turned(motion.covariance, float(before[2]))
        self._reckoned = (after, carried(covariance, after[:2] - before[:2]) + Q)

    def _points(self, scan: Scan) -> Array:
        """Surface points (N, 5) that can be matched, robot frame."""
        return surface_points(scan, self.config.match_range_m)

    def _match(self, scan: Scan, points: Array, prior: Array) -> Match | None:
        if len(points) < FEWEST_POINTS or self._map.is_empty:
            return None
        if np.ptp(points[:, :2], axis=0).max() < self.config.match_cell_m:
            return None  # all in one place: they tell no pose
        return self._matcher.match(points, scan.T_base_laser, self._map, prior, self._since_fit)

    def _take(self, match: Match, before: Array, prior: Array, Q: Array, stands: bool) -> None:
        """The pose of a match, and what it says of the motion, and of where the robot is."""
        self._pose = match.T_map_base
        off = se2.off(match.T_map_base, prior)
        if self._is_unexpected(match, prior):
            # Scan and motion contradict each other: one of them is wrong, or the match has led back
            # to what was mapped before, which is no motion.
            self._jump = self._jump + np.outer(off, off)
            if not self._is_unplaced:
                half = _half_squared(match.T_map_base, prior)
                self._reversal = Reversal(-0.5 * off, half)
        if match.fit >= self.config.match_least_fit:
            by_scan = turned(match.by_scan, -float(before[2]))
            self._motion.learn(se2.between(before, match.T_map_base), by_scan)
            self._since_fit = np.zeros((3, 3))
        else:
            self._since_fit = match.covariance
        if not stands:
            by_motion = inverse(self._since_learned + Q)
            self._since_learned = inverse(by_motion + match.by_scan)
            self._by_motion = self._since_learned @ by_motion @ self._since_learned
        if match.fit >= self.config.match_least_fit:
            self._calibration.follow(self._pose, match.by_scan)

    def _is_unexpected(self, match: Match, prior: Array) -> bool:
        """Whether a match contradicts the motion."""
        off = se2.off(match.T_map_base, prior)
        return float(off @ np.linalg.solve(self._since_fit, off)) > _CHI2

    def _is_refused(self, match: Match, prior: Array) -> bool:
        """Whether a match contradicts the motion, and many of its points the map: it is chance.

        Not of a robot that was put somewhere: where it was before says nothing.
        """
        by_chance = match.fit < _FOR_A_SLIP * match.contradicted
        return by_chance and self._is_unexpected(match, prior) and not self._is_unplaced

    def _judge(self, match: Match) -> None:
        """Whether scans contradict the map.

        Cumulative sum of the share of points that do, less that of those that fit. Source: Page,
        "Continuous inspection schemes", 1954.
        """
        most = self.config.lost_evidence
        self._evidence = max(self._evidence + match.contradicted - match.fit, 0.0)
        if self._is_unplaced:
            self._evidence = min(self._evidence, most)
            self._is_unplaced = self._evidence > 0.0 or match.fit < self.config.match_least_fit

    def _learn(self, scan: Scan, points: Array) -> None:
        """Take the scan into the map, if the robot has moved since it last learned."""
        moved = np.zeros(3) if self._T_learned is None else se2.between(self._T_learned, self._pose)
        way_m = math.hypot(moved[0], moved[1])
        turn = abs(float(moved[2]))
        config = self.config
        near = way_m < config.map_distance_m and turn < config.map_turn_rad
        if self._T_learned is not None and near:
            return
        self._adrift_m = max(self._adrift_m - way_m, 0.0)
        if self._evidence > config.lost_evidence:
            self._begin_submap()
        if config.slam != 'off':
            self._observe_lines(scan)
        self._map.add_scan(points, scan.T_base_laser, self._pose)
        # What the motion leaves is new with every step; what the scan leaves is much the same error
        # as in the step before, as long as the same walls are seen.
        share = min(1.0, way_m / _VIEW_M + turn)
        by_scan = self._since_learned - self._by_motion
        self._since_anchor = self._since_anchor + self._by_motion + share * by_scan
        self._at_learning = (1.0 - share) * by_scan
        self._since_learned = np.zeros((3, 3))
        self._by_motion = np.zeros((3, 3))
        self._T_learned = self._pose
        if len(points) >= FEWEST_POINTS and self._loops.is_due(self._pose):
            self._keep(scan, points)

    def _observe_lines(self, scan: Scan) -> None:
        """Update the line features, and the heading by them where scans agree with the map.

        The direction of the walls of the building tells it, too: new walls are then drawn straight.
        """
        by_scan = self._since_learned - self._by_motion
        self._yaw_variance += float(self._by_motion[2, 2] + _NEW_SHARE * by_scan[2, 2])
        heading = self._lines.observe(scan, self._pose, _BESIDE_WALLS)
        if self._evidence == 0.0:
            lines = self._lines.lines
            told = self._compass.read(lines, heading, self._yaw_variance)
            if told is not None:
                gain = self._yaw_variance / (self._yaw_variance + told.variance)
                heading = float(se2.wrap(heading + gain * (told.yaw - heading)))
                self._yaw_variance *= 1.0 - gain
            self._compass.learn(lines, heading, self._loops.path_m(self._pose))
            self._pose = se2.pose(float(self._pose[0]), float(self._pose[1]), heading)
            self._T_stood = self._pose
            self._reckoned = (self._pose, self._since_fit)

    def _keep(self, scan: Scan, points: Array) -> None:
        """Make the scan a keyframe."""
        loops = self._loops
        anchor = loops.keyframes.anchor
        theta = 0.0 if anchor < 0 else float(self.keyframes[anchor].T_map_base[2])
        step = turned(self._since_anchor, -theta) + np.diag(np.square(_STEP_SIGMAS))
        path_m = loops.path_m(self._pose)
        frame = Keyframe(scan, points, self._pose, path_m, self._covariance(), self._submap)
        loops.add(frame, step, turned(self._jump, -theta))
        self._since_anchor = np.zeros((3, 3))
        self._at_learning = np.zeros((3, 3))
        self._jump = np.zeros((3, 3))

    def _begin_submap(self) -> None:
        """Go on in a new local map: where the robot is in the old one is not known any more.

        The new one lies where the motion has led since a scan agreed with the old one: the matches
        since then were with what contradicts them, as in a crowd.
        """
        sigma = _SIGMAS * np.array([self.config.slip_m] * 2 + [self.config.slip_rad])
        self._pose, covariance = self._reckoned
        self._calibration.interrupt()
        self._T_stood = self._pose
        covariance = covariance + np.diag(np.square(sigma))
        self._jump = self._jump + covariance
        self._since_anchor = self._since_anchor + covariance
        self._map = LocalMap(self.config)
        self._due = []
        self._submap += 1
        self._evidence = 0.0
        self._since_fit = np.zeros((3, 3))
        self._adrift_m = _ADRIFT_M

    def _apply(self, correction: Correction) -> None:
        """A loop was closed: pose, features and local map go where the keyframes have gone."""
        anchor = self._loops.keyframes.anchor
        self._calibration.interrupt()
        self._pose = correction.moved(anchor, self._pose)
        self._reckoned = (correction.moved(anchor, self._reckoned[0]), self._reckoned[1])
        self._T_learned = self._pose
        self._T_stood = self._pose
        self._adrift_m = 0.0
        self._lines.move(correction)
        self._draw_anew()

    def _draw_anew(self) -> None:
        """Begin to draw the local map anew from the keyframes, the nearest first."""
        self._map = LocalMap(self.config)
        if self._given is not None:
            self._map.restore(self._given)
        poses = self._loops.keyframes.poses()
        away = np.hypot(*(poses[:, :2] - self._pose[:2]).T)
        self._due = np.argsort(-away).tolist()
        self._draw(_AT_ONCE)

    def _draw(self, count: int) -> None:
        """Draw some of the keyframes that are due."""
        for _ in range(min(count, len(self._due))):
            frame = self.keyframes[self._due.pop()]
            self._map.add_scan(frame.points, frame.scan.T_base_laser, frame.T_map_base)

    def _note(self, scan: Scan) -> None:
        """Keep the pose of the step, as seen from the anchor."""
        anchor = self._loops.keyframes.anchor
        seen_from = np.zeros(3) if anchor < 0 else self.keyframes[anchor].T_map_base
        self._path.add(scan.stamp_ns, anchor, se2.between(seen_from, self._pose))

    def _covariance(self) -> Array:
        """Covariance (3, 3) of the pose, map frame."""
        # The pose errs as the scan that the map learned from, until it errs by more.
        here = max(self._at_learning, self._since_learned, key=np.trace)
        own = self._since_anchor + here
        anchor = self._loops.keyframes.anchor
        if anchor >= 0:
            frame = self.keyframes[anchor]
            own = own + carried(frame.covariance, self._T_stood[:2] - frame.T_map_base[:2])
        return np.asarray(0.5 * (own + own.T))

    def _estimate(self, match: Match | None, correction: Correction | None) -> Estimate:
        lost = self._adrift_m > 0.0 or (self._is_unplaced and self._evidence > 0.0)
        covariance = self._covariance()
        if lost:
            covariance = covariance + np.diag([_UNKNOWN_M**2, _UNKNOWN_M**2, math.pi**2])
        return Estimate(
            self._pose,
            covariance,
            se2.compose(self._pose, se2.invert(self._odometry.T_odom_base)),
            self._lines.observed,
            self._lines.matched,
            len(self._lines),
            self._lines.local_count,
            0.0 if match is None else match.fit,
            lost,
            correction,
        )
