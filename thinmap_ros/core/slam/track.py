"""The pose of each scan: predicted by odometry, measured by a match with the local map.

A correction of the keyframes moves the anchor, and thereby all that is relative to it: nothing here
has to be told.
"""

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import parameter, parameters_of, part
from thinmap_ros.core.ekf_slam.features import LineConfig, odometry_slip
from thinmap_ros.core.scan import Scan, few_beams_reason
from thinmap_ros.core.se2 import (
    BOUND_SIGMAS,
    Array,
    propagated_covariance,
    rotated_covariance,
    rotation,
)
from thinmap_ros.core.slam.continuity import Motion, continues, continuity, log_ratio
from thinmap_ros.core.slam.graph.keyframes import Anchor, KeyframeConfig
from thinmap_ros.core.slam.graph.loop_closure import LoopClosureConfig
from thinmap_ros.core.slam.matching.local_map import LocalMap, LocalMapConfig
from thinmap_ros.core.slam.matching.scan_matcher import MIN_POINTS, Match, Matcher, MatchingConfig
from thinmap_ros.core.slam.matching.visibility import (
    NOTHING,
    SeenThrough,
    misses_walls,
    seen_through,
)
from thinmap_ros.core.slam.odometry import (
    MotionConfig,
    OdometryPrediction,
    PoseUncertainty,
    Prediction,
)
from thinmap_ros.core.slam.place_belief import INLIERS_PER_CONTRADICTION, PlaceBelief
from thinmap_ros.core.stage import SCAN_MATCHING, StartConfig


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
    map_tag: str = parameter(
        '',
        'Storey that the map shows, any name; empty: not known. Maps of two storeys are never '
        'joined, those of one are joined by their views alone. It is saved with the map, and a map '
        'of another storey is not loaded.',
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


_NO_RETURNS = 'no returns from walls of the map'

_START_LOOK_M = 1.0  # between two looks that judge a given pose


@dataclass(frozen=True, eq=False)
class DeadReckoning:
    """Dead-reckoned pose (3,) since the last scan that agreed, with covariance (3, 3)."""

    T_anchor_base: Array
    covariance: Array

    def moved(self, prediction: Prediction) -> 'DeadReckoning':
        """The dead-reckoned pose after the motion of a prediction."""
        motion = prediction.motion
        before = self.T_anchor_base
        after = se2.compose(before, motion.increment)
        Q = rotated_covariance(motion.covariance, float(before[2]))
        lever = after[:2] - before[:2]
        return DeadReckoning(after, propagated_covariance(self.covariance, lever) + Q)

    def seen_from(self, T_old_new: Array) -> 'DeadReckoning':
        """The same relative to another anchor, at a pose (3,) relative to the present one."""
        return DeadReckoning(
            se2.between(T_old_new, self.T_anchor_base),
            rotated_covariance(self.covariance, -float(T_old_new[2])),
        )


@dataclass(frozen=True, eq=False)
class LastLook:
    """A scan with which the next ones of its laser are compared; T_scan_base (3,): odometry since.

    is_kept: whether the last scan was compared with it, too.
    """

    scan: Scan
    T_scan_base: Array
    is_kept: bool = False


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
    """Predicts, matches and updates the pose relative to the anchor, T_anchor_base (3,).

    uncertainty, reckoned, T_anchor_update: relative to the anchor, too; the last is the pose of the
    scan that was last added to the map, None before the first. belief: of the place.
    """

    def __init__(self, config: LocalizerConfig) -> None:
        self._config = config
        self._matcher = Matcher(config.matching)
        self._slip = BOUND_SIGMAS * odometry_slip(config.odometry)  # of a robot that does not move
        self.prediction = OdometryPrediction(config.odometry)
        start = se2.pose(config.initial_x_m, config.initial_y_m, config.initial_yaw_rad)
        self.T_anchor_base = start
        self.uncertainty = PoseUncertainty(start)
        self.belief = PlaceBelief(config.lost_threshold, config.matching.min_inlier_ratio)
        self.reckoned = DeadReckoning(start, np.zeros((3, 3)))
        self.T_anchor_update: Array | None = None
        self._looks: dict[str, LastLook] = {}  # by the frame of the laser
        # Of a given pose that is judged: it (3,), and that of the last look, map frame.
        self._start: tuple[Array, Array] | None = None

    def adjust(self, config: LocalizerConfig) -> None:
        """Continue with other values of `LIVE_PARAMETERS`."""
        self._config = config
        self._matcher = Matcher(config.matching)
        self.belief.adjust(config.lost_threshold, config.matching.min_inlier_ratio)

    @property
    def since_update(self) -> Array | None:
        """Motion (3,) since the last map update; None before the first."""
        update = self.T_anchor_update
        return None if update is None else se2.between(update, self.T_anchor_base)

    def step(self, scan: Scan, points: Array, T_odom_base: Array, there: Surroundings) -> Tracked:
        """Track a scan with surface points (N, 5), given the odometry pose (3,) at its stamp.

        Where an error ends it, the scan is left out, and the motion up to it is not.
        """
        before = self.T_anchor_base
        prediction = self.prediction.predict(scan, T_odom_base, before, there.revision)
        is_stationary = self._is_stationary(prediction)
        by_calibration = rotation(float(before[2])) @ prediction.motion.by_calibration
        self.uncertainty.predict(
            before, prediction.prior, prediction.covariance, is_stationary, by_calibration
        )
        self.reckoned = self.reckoned.moved(prediction)
        self._move_looks(se2.between(before, prediction.prior))
        is_known = not self.belief.is_delocalized  # else a match corrects the pose that was given
        try:
            tracked = self._measure(scan, points, prediction, is_stationary, there)
        except Exception:
            self.T_anchor_base = prediction.prior
            self.uncertainty.coast(prediction.prior, prediction.covariance, is_stationary)
            raise
        if is_known and not self.belief.is_doubted:
            self._move_looks(se2.between(prediction.prior, self.T_anchor_base))
        self._take_look(scan)
        return tracked

    def _measure(
        self,
        scan: Scan,
        points: Array,
        prediction: Prediction,
        is_stationary: bool,
        there: Surroundings,
    ) -> Tracked:
        """Match a scan at its predicted pose, and update the pose by it."""
        before = prediction.before
        match = self._match(scan, points, prediction.prior, there)
        moved_m = 0.0 if is_stationary else float(np.hypot(*(prediction.prior - before)[:2]))
        through = self._seen_through(scan, match, there)
        own = None if match is None else match.seen_from(there.anchor.T_map)
        self._judge_motion(scan, prediction, own)
        if match is not None and self.belief.is_start_judged:
            self._judge_start(scan, points, match, there)
        self.belief.update(match, through, is_stationary, moved_m)
        fits = self._update(own, prediction, is_stationary)
        if fits and match is not None:
            systematic = self.systematic(there.anchor)
            self.prediction.calibration.update(match.pose, match.scan_information, systematic)
        self._record_agreement()
        blind_reason = self._blind_reason(scan, points, match, there)
        return Tracked(match, fits, prediction.discontinuity, blind_reason)

    def place(self, T_anchor_base: Array, covariance: Array) -> None:
        """Set the pose (3,) with covariance (3, 3), relative to any anchor, without any motion."""
        self.prediction.reset_segment()
        self._looks.clear()
        self._start = None
        self.T_anchor_base = T_anchor_base
        self.T_anchor_update = None
        self.uncertainty.place(T_anchor_base, covariance)
        self.reckoned = DeadReckoning(T_anchor_base, self.uncertainty.since_match)

    def turn(self, T_anchor_base: Array) -> None:
        """Set the pose (3,) after its heading was measured by other means than the map."""
        self.T_anchor_base = T_anchor_base
        self.uncertainty.T_moved = T_anchor_base
        self._record_agreement()

    def begin_step(self) -> None:
        """Make the present pose the anchor: a keyframe scan."""
        T_old_new = self.T_anchor_base
        self.T_anchor_base = np.zeros(3)
        self.uncertainty.start_step(T_old_new)
        self.reckoned = self.reckoned.seen_from(T_old_new)
        if self.T_anchor_update is not None:
            self.T_anchor_update = se2.between(T_old_new, self.T_anchor_update)

    def fall_back(self) -> Array:
        """Return to the dead-reckoned pose: later matches, as in a crowd, are not reliable.

        Returns its covariance (3, 3).
        """
        self.prediction.reset_segment()
        self._looks.clear()
        self.T_anchor_base = self.reckoned.T_anchor_base
        return self.reckoned.covariance + self.slip_covariance()

    def slip_covariance(self) -> Array:
        """Covariance (3, 3) of a pose after the largest expected wheel slip."""
        return np.diag(np.square(BOUND_SIGMAS * np.array(self._config.matching.wheel_slip)))

    def random_covariance(self, anchor: Anchor) -> Array:
        """Covariance (3, 3) of the independent errors of the pose, map frame."""
        uncertainty = self.uncertainty
        return anchor.covariance_at(uncertainty.T_moved, uncertainty.since_anchor)

    def systematic(self, anchor: Anchor) -> Array:
        """Derivative (3, 4) of the pose by the calibration of the odometry, map frame."""
        uncertainty = self.uncertainty
        return anchor.systematic_at(uncertainty.T_moved, uncertainty.systematic)

    def covariance(self, anchor: Anchor) -> Array:
        """Covariance (3, 3) of the pose, map frame."""
        systematic = self.prediction.calibration.covariance_of(self.systematic(anchor))
        total = self.random_covariance(anchor) + systematic
        return np.asarray(0.5 * (total + total.T))

    def _record_agreement(self) -> None:
        """Restart dead reckoning at the pose of this scan if the scan agrees with the map."""
        if self.belief.agrees:
            self.reckoned = DeadReckoning(self.T_anchor_base, self.uncertainty.since_match)

    def _is_stationary(self, prediction: Prediction) -> bool:
        """Whether the robot has moved by no more than the odometry noise."""
        is_still = self.uncertainty.is_stationary(prediction.prior, self._slip)
        return prediction.motion.is_stationary and is_still

    def _judge_motion(self, scan: Scan, prediction: Prediction, match: Match | None) -> None:
        """Update the belief by what a scan shows of the last one; match: relative to the anchor."""
        look = self._looks.get(scan.frame)
        if look is None:
            return
        motions = [Motion(look.T_scan_base)]
        if match is not None:
            off = se2.pose_difference(match.pose, prediction.prior)
            expected = prediction.covariance + self.slip_covariance() / BOUND_SIGMAS**2
            likelihood = -0.5 * float(off @ np.linalg.solve(expected, off))
            by_match = se2.compose(look.T_scan_base, se2.between(prediction.prior, match.pose))
            motions.append(Motion(by_match, likelihood))
        is_again = look.is_kept and (
            self._is_at_rest(look) or continues(look.scan, scan, look.T_scan_base, is_told=True)
        )
        self.belief.move(continuity(look.scan, scan, motions), is_again)

    def _judge_start(self, scan: Scan, points: Array, match: Match, there: Surroundings) -> None:
        """Judge a given pose by how a scan fits on the path from there, and at other headings.

        Each place counts once: the robot may be elsewhere, or it stands turned by a right angle, as
        walls do. Furniture may have changed since a map was made that stays as it is: there the
        headings alone are compared.
        """
        here = match.pose
        start, last = self._start or (here, None)
        if last is not None and math.dist(here[:2], last[:2]) < _START_LOOK_M:
            return
        self._start = (start, here)
        there_fits = log_ratio(match.inlier_ratio, 0.0)
        since = se2.between(start, here)
        others = [
            self._matcher.match(
                points,
                scan.T_base_laser,
                there.local_map,
                se2.compose(se2.compose(start, np.array([0.0, 0.0, turn])), since),
                self.slip_covariance(),
            ).inlier_ratio
            for turn in (0.5 * math.pi, math.pi, -0.5 * math.pi)
        ]
        turned = there_fits - log_ratio(max(others), 0.0)
        self.belief.judge_start(min(there_fits, turned) if self._config.is_mapping else turned)

    def _is_at_rest(self, look: LastLook) -> bool:
        """Whether the robot has not moved since a look, but for the noise of the odometry."""
        return bool((np.abs(look.T_scan_base) <= self._slip).all())

    def _move_looks(self, moved: Array) -> None:
        """Move on by a motion (3,) since all looks."""
        for frame, last in self._looks.items():
            self._looks[frame] = replace(last, T_scan_base=se2.compose(last.T_scan_base, moved))

    def _take_look(self, scan: Scan) -> None:
        """Compare the next scans with this one, unless the robot rests.

        At rest they are compared with the first one: a robot that is carried away slowly sees the
        walls move.
        """
        look = self._looks.get(scan.frame)
        if look is None or not self._is_at_rest(look):
            self._looks[scan.frame] = LastLook(scan, np.zeros(3))
        else:
            self._looks[scan.frame] = replace(look, is_kept=True)

    def _match(self, scan: Scan, points: Array, prior: Array, there: Surroundings) -> Match | None:
        """Match a scan with the local map; None if scan or map have too little structure.

        Where it fits badly and does not continue the last one, neither at the motion of the
        odometry nor at that of the match, all headings are searched: the odometry may not have seen
        a turn. After a turn it continues the last one, and at a place that looks alike it does not.
        """
        if len(points) < MIN_POINTS or there.local_map.is_empty:
            return None
        if np.ptp(points[:, :2], axis=0).max() < self._config.local_map.resolution_m:
            return None  # all points in one cell do not determine a pose
        T_map = there.anchor.T_map
        covariance = rotated_covariance(self.uncertainty.since_match, float(T_map[2]))
        prior = there.anchor.pose(prior)
        given = (points, scan.T_base_laser, there.local_map, prior, covariance)
        match = self._matcher.match(*given)
        fits = match.inlier_ratio >= self._config.matching.min_inlier_ratio
        look = self._looks.get(scan.frame)
        is_parked = look is not None and look.is_kept and self.belief.is_doubted
        if fits or look is None or is_parked:
            return match

        def shows_last(T_map_base: Array) -> bool:
            moved = se2.compose(look.T_scan_base, se2.between(prior, T_map_base))
            return continues(look.scan, scan, moved)

        if shows_last(prior) or shows_last(match.pose):
            return match
        turned = self._matcher.match(*given, is_turned=True)
        return turned if shows_last(turned.pose) else match

    def _seen_through(self, scan: Scan, match: Match | None, there: Surroundings) -> SeenThrough:
        """Walls of the map that this localizer makes, and that a scan sees through.

        In a map that does not change, the inliers alone tell where the robot is; and its furniture
        may have changed.
        """
        if match is None or not self._config.is_mapping:
            return NOTHING
        # At a given pose no drift explains them: it is right or wrong.
        is_given = self.belief.is_delocalized
        covariance = np.zeros((3, 3)) if is_given else self.covariance(there.anchor)
        return seen_through(scan, there.local_map, match.pose, covariance)

    def _update(self, match: Match | None, prediction: Prediction, is_stationary: bool) -> bool:
        """Set the pose to that of an accepted match, or else to the predicted one.

        match: relative to the anchor. Returns whether it was accepted and fits.
        """
        prior = prediction.prior
        uncertainty = self.uncertainty
        is_unexpected = match is not None and uncertainty.is_unexpected(match, prior)
        accepted = match is not None and not self._is_rejected(match, is_unexpected)
        # After set_pose an innovation is due to the given pose, and not to the odometry.
        if match is not None and is_unexpected and not self.belief.is_delocalized:
            self.prediction.contradict(prediction, match, accepted)
        if match is None or not accepted:
            self.T_anchor_base = prior
            uncertainty.coast(prior, prediction.covariance, is_stationary)
            return False
        self.T_anchor_base = match.pose
        fits = match.inlier_ratio >= self._config.matching.min_inlier_ratio
        uncertainty.update(match, prior, prediction.covariance, fits, is_stationary)
        if fits:
            self.prediction.update(prediction, match)
        return fits

    def _is_rejected(self, match: Match, is_unexpected: bool) -> bool:
        """Whether the pose of a match is worse than the predicted one.

        So it is where the robot was kidnapped. An unexpected match is, if many of its points
        contradict the map. After scans that could not be matched, one that fits badly is: a few
        points fit somewhere within a wide prior.
        """
        if self.belief.is_elsewhere:
            return True
        if self.belief.is_delocalized:
            return False
        if is_unexpected and (
            match.inlier_ratio < INLIERS_PER_CONTRADICTION * match.contradiction_ratio
        ):
            return True
        is_wide = self._config.matching.is_wide(self.uncertainty.since_match)
        return self.belief.is_unconfirmed and is_wide

    def _blind_reason(
        self, scan: Scan, points: Array, match: Match | None, there: Surroundings
    ) -> str:
        """Why the laser does not confirm the pose; '' if it does, or if no wall is in range."""
        if match is not None or scan.is_blind:
            return scan.blind_reason
        has_confirmed = not self._config.is_mapping or there.has_keyframes
        is_confirmed = has_confirmed and not self.belief.is_delocalized
        sparse_reason = few_beams_reason(scan) or _sparse_reason(scan, points, is_confirmed)
        if sparse_reason or there.is_apart or self.belief.is_lost:
            return sparse_reason
        T_map_base = there.anchor.pose(self.T_anchor_base)
        misses = misses_walls(scan, there.local_map, T_map_base, self.covariance(there.anchor))
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
