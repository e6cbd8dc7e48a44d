"""The pose of each scan: predicted by odometry, measured by a match with the local map.

A correction of the keyframes moves the anchor, and thereby all that is relative to it: nothing here
has to be told.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.config import parameter, parameters_of, part
from thinmap_ros.core.ekf_slam.features import LineConfig, odometry_slip
from thinmap_ros.core.grid.tiles import NO_TILE
from thinmap_ros.core.places.views import WINDOW_M
from thinmap_ros.core.scan import Scan, few_beams_reason, is_most_missed
from thinmap_ros.core.se2 import (
    BOUND_SIGMAS,
    Array,
    propagated_covariance,
    rotated_covariance,
    rotation,
)
from thinmap_ros.core.slam.graph.keyframes import Anchor, KeyframeConfig
from thinmap_ros.core.slam.graph.loop_closure import LoopClosureConfig
from thinmap_ros.core.slam.matching.local_map import (
    MIN_HIT_RATIO,
    TILE_MASK,
    LocalMap,
    LocalMapConfig,
    LocalMapView,
    cell_of,
    cells_to_wall,
    is_wall,
    slot_of,
)
from thinmap_ros.core.slam.matching.scan_matcher import MIN_POINTS, Match, Matcher, MatchingConfig
from thinmap_ros.core.slam.odometry import (
    MotionConfig,
    OdometryPrediction,
    PoseUncertainty,
    Prediction,
)
from thinmap_ros.core.stage import SCAN_MATCHING, StartConfig
from thinmap_ros.jit import kernel


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

# Of the walls of the local map that beams would hit, or have passed through.
_REACH = 0.9  # of range_max: a farther wall may be out of range

_STEP_CELLS = 0.5

_BETWEEN_CELLS = 2.0  # a way may end in a cell whose offset is longer by less than this

_BEHIND_M = 0.3  # by which a beam ends behind a wall that it has passed through

_MIN_HITS = 2  # of a cell that is a wall for certain

_MAX_COSINE = 0.5  # cosine; more oblique beams pass the cells of a wall beside them

_SAME_SIDE = 0.5  # length of the mean double-angle vector of normals that agree


def misses_walls(scan: Scan, local_map: LocalMap, T_map_base: Array, covariance: Array) -> bool:
    """Whether a scan has no return from most of the walls in range of a pose.

    T_map_base (3,) with covariance (3, 3), map frame.
    """
    reach_m = _REACH * scan.range_max_m - _uncertainty_m(covariance)
    if local_map.is_empty or not reach_m > 0.0:
        return False
    T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
    angles = T_map_laser[2] + scan.angles_rad[scan.no_return]
    missed = _count_walls(angles, T_map_laser, reach_m, local_map.lattice, MIN_HIT_RATIO)
    return is_most_missed(scan, missed)


class SeenThrough(NamedTuple):
    """Walls of the map (M, 2), m, map frame, behind which a scan has returns; ratio: of all."""

    walls: Array
    ratio: float


NOTHING = SeenThrough(np.empty((0, 2)), 0.0)


def seen_through(
    scan: Scan, local_map: LocalMap, T_map_base: Array, covariance: Array
) -> SeenThrough:
    """What a scan sees through, one wall for each return that lies behind one.

    T_map_base (3,) with covariance (3, 3), map frame: a return behind a wall by no more than the
    pose is uncertain may lie in front of it. So drift up to a loop is told from a robot that was
    carried off.
    """
    returned = scan.returned
    total = int(np.count_nonzero(returned))
    if local_map.is_empty or total == 0:
        return NOTHING
    T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
    angles = T_map_laser[2] + scan.angles_rad[returned]
    reaches_m = scan.ranges_m[returned] - _BEHIND_M - _uncertainty_m(covariance)
    walls = _walls_through(angles, reaches_m, T_map_laser, local_map.lattice, MIN_HIT_RATIO)
    return SeenThrough(walls, len(walls) / total)


def _uncertainty_m(covariance: Array) -> float:
    """How far a position with a covariance (3, 3) may be off, m."""
    return BOUND_SIGMAS * math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))


@kernel
def _walls_through(
    angles: Array, reaches_m: Array, laser: Array, lattice: LocalMapView, hit_ratio: float
) -> Array:
    """Nearest wall within the reach of each beam that has one, (M, 2), m, map frame.

    Of beams at angles (N,), map frame, with reaches (N,), m. laser (3,): its pose.
    """
    walls = np.empty((len(angles), 2))
    count = 0
    x0 = laser[0] / lattice.cell_m - lattice.first_col
    y0 = laser[1] / lattice.cell_m - lattice.first_row
    for i in range(len(angles)):
        cos = math.cos(angles[i])
        sin = math.sin(angles[i])
        steps = int(reaches_m[i] / (_STEP_CELLS * lattice.cell_m))
        step = 0
        while step < steps:
            step += 1
            row = cell_of(y0 + step * _STEP_CELLS * sin)
            col = cell_of(x0 + step * _STEP_CELLS * cos)
            slot = slot_of(lattice, row, col)
            if slot == NO_TILE:
                continue
            cell = lattice.pool[slot, row & TILE_MASK, col & TILE_MASK]
            free = min(cells_to_wall(cell), lattice.reach) - _BETWEEN_CELLS
            if free > 0.0:
                step += int(free / _STEP_CELLS)
                continue
            if cell['hits'] < _MIN_HITS or not is_wall(cell, hit_ratio):
                continue
            wall = lattice.surfaces[slot, row & TILE_MASK, col & TILE_MASK]
            if math.hypot(wall['cos2'], wall['sin2']) < _SAME_SIDE:
                continue
            normal = 0.5 * math.atan2(wall['sin2'], wall['cos2'])
            if abs(math.cos(normal) * cos + math.sin(normal) * sin) > _MAX_COSINE:
                walls[count, 0] = laser[0] + step * _STEP_CELLS * lattice.cell_m * cos
                walls[count, 1] = laser[1] + step * _STEP_CELLS * lattice.cell_m * sin
                count += 1
                break
    return walls[:count]


@kernel
def _count_walls(
    angles: Array, laser: Array, reach_m: float, lattice: LocalMapView, hit_ratio: float
) -> int:
    """Number of beams at angles (N,), map frame, that hit a wall; laser (3,): its pose."""
    steps = int(reach_m / (_STEP_CELLS * lattice.cell_m))
    count = 0
    for i in range(len(angles)):
        x = laser[0] / lattice.cell_m - lattice.first_col
        y = laser[1] / lattice.cell_m - lattice.first_row
        dx = _STEP_CELLS * math.cos(angles[i])
        dy = _STEP_CELLS * math.sin(angles[i])
        for _ in range(steps):
            x += dx
            y += dy
            row = cell_of(y)
            col = cell_of(x)
            slot = slot_of(lattice, row, col)
            if slot == NO_TILE:
                continue
            if is_wall(lattice.pool[slot, row & TILE_MASK, col & TILE_MASK], hit_ratio):
                count += 1
                break
    return count


# Inliers for each contradicting point with which a match overrides the odometry.
INLIERS_PER_CONTRADICTION = 3.0

# Ratio of returns behind walls, between that of the worst real log (mean 0.11, of an office with
# much glass) and that of robots that were kidnapped (mean 0.4 in the first seconds).
_SEEN_THROUGH = 0.25

_OPENING_RADIUS_M = 1.5  # a gate for hospital beds, or two leaves of an automatic door

# Of a pose that no scan has confirmed: less than a scan with 30 % inliers removes.
_UNCONFIRMED_EVIDENCE = 0.3 / INLIERS_PER_CONTRADICTION


class _Trial:
    """A start pose that nobody gave: it is confirmed by scans that fit over the path of a view.

    Some scans fit anywhere, and a map that they change soon agrees with all that follow. Of 20
    starts elsewhere in generated buildings, 13 were mapped at a wrong pose without a trial, 3 with
    one of 1.5 m or of 3 m, and none with this.
    """

    def __init__(self, is_guess: bool) -> None:
        """is_guess: whether the robot is lost until the pose is confirmed."""
        self.is_guess = is_guess
        self._path_m = 0.0
        self._fitting_m = 0.0  # path since a scan did not fit

    def add(self, moved_m: float, fits: bool) -> None:
        """Add a scan that was made after some more path; fits: whether it agrees with the map."""
        self._path_m += moved_m
        self._fitting_m = self._fitting_m + moved_m if fits else 0.0

    @property
    def is_passed(self) -> bool:
        """Whether the pose is confirmed."""
        return self._fitting_m > WINDOW_M

    @property
    def is_failed(self) -> bool:
        """Whether no view has confirmed it where there was room for two."""
        return not self.is_passed and self._path_m > 2.0 * WINDOW_M


class _Opening:
    """Whether one opening explains what is seen through: a door, or a cupboard that is gone.

    A kidnapped robot sees through walls all around. One that waits before an automatic door
    and then drives through it sees through that alone, with most of its beams for some metres.
    """

    def __init__(self) -> None:
        self._centre: Array | None = None
        self._within = 0.0  # sums of ratios of returns, since there is evidence
        self._beside = 0.0

    @property
    def explains_most(self) -> bool:
        """Whether most of what was seen through since there is evidence is within one opening."""
        return self._within > self._beside

    def add(self, seen: SeenThrough) -> None:
        """Add what a scan sees through."""
        if not len(seen.walls):
            return
        if self._centre is None:
            self._centre = np.median(seen.walls, axis=0)
        is_beside = np.hypot(*(seen.walls - self._centre).T) > _OPENING_RADIUS_M
        beside = seen.ratio * float(np.mean(is_beside))
        self._beside += beside
        self._within += seen.ratio - beside


class MapEvidence:
    """Detects by CUSUM tests that scans contradict the map.

    The evidence sums up the contradiction ratio less a third of the inlier ratio, and is never
    negative. A map that grows soon fits wherever the robot is: the walls that are seen through are
    evidence of their own, which no inlier reduces.
    Source: Page, "Continuous inspection schemes", 1954.
    """

    def __init__(
        self,
        lost_threshold: float,
        least_fit: float,
        loaded_evidence: float = 0.5,
    ) -> None:
        """loaded_evidence: initial evidence in a loaded map: one or two fitting scans remove it."""
        self._loaded_evidence = loaded_evidence
        self.level = 0.0
        self._seen_through = 0.0
        self._before_look = 0.0  # the same before the present look
        self._opening = _Opening()
        self._is_foreign = False  # whether the last scan may be one of another place
        self.is_delocalized = False  # in a loaded map, or after set_pose, until scans fit
        self._trial: _Trial | None = None
        self.is_unconfirmed = False  # after a scan without a match, until one fits
        self.adjust(lost_threshold, least_fit)

    def adjust(self, lost_threshold: float, least_fit: float) -> None:
        """Set the evidence at which the robot is lost, and the inlier ratio of a scan that fits."""
        self._lost_evidence = lost_threshold
        self._least_fit = least_fit

    @property
    def agrees(self) -> bool:
        """Whether there is no evidence against the map."""
        return self.level == 0.0 and self._seen_through == 0.0

    @property
    def permits_mapping(self) -> bool:
        """Whether scans agree with the map, and do so at a pose that is given or confirmed."""
        return self.agrees and self._trial is None

    @property
    def forbids_mapping(self) -> bool:
        """Whether the last scan may show another place than the map does.

        A map that such scans change soon agrees with them, wherever the robot is. A scan that fits
        shows this place, with people or furniture.
        """
        return self._is_foreign

    @property
    def _is_grave(self) -> bool:
        """Whether the evidence is more than half of what makes the robot lost."""
        return 2.0 * max(self.level, self._seen_through) > self._lost_evidence

    @property
    def is_lost(self) -> bool:
        """Whether scans have not confirmed the pose at which the robot was placed in the map."""
        is_guess = self._trial is not None and self._trial.is_guess
        return self.is_delocalized and (is_guess or not self.agrees)

    @property
    def needs_submap(self) -> bool:
        """Whether the evidence against the map, or against a given pose, reaches the threshold."""
        if self._trial is not None and self._trial.is_failed:
            return True
        if self.level >= self._lost_evidence:
            return True
        return self._seen_through >= self._lost_evidence and not self._opening.explains_most

    def update(
        self,
        match: Match | None,
        seen_through: SeenThrough = NOTHING,
        is_stationary: bool = False,
        moved_m: float = 0.0,
    ) -> None:
        """Update the evidence by a match; None (no match was possible) leaves it unchanged.

        seen_through: walls of the map that it sees through; is_stationary: whether the scan is of
        the same look as the last one, and no evidence of its own; moved_m: path since that one.
        """
        if match is None:
            self.is_unconfirmed = True
            return
        fits = match.inlier_ratio >= self._least_fit
        if fits:
            self.is_unconfirmed = False
        more = match.contradiction_ratio
        if fits or not self._is_grave:  # a third of the points fit anywhere
            more -= match.inlier_ratio / INLIERS_PER_CONTRADICTION
        self._is_foreign = not fits and (more > 0.0 or self._is_grave)
        self.level = max(self.level + more, 0.0)
        if not is_stationary:
            self._end_look(self._seen_through)
        self._seen_through = max(self._before_look + seen_through.ratio - _SEEN_THROUGH, 0.0)
        if self._seen_through > 0.0:
            self._opening.add(seen_through)
        if self.is_delocalized:
            self.level = min(self.level, self._lost_evidence)
            agrees = self.agrees and fits
            is_confirmed = self._is_confirmed(moved_m, agrees)
            self.is_delocalized = not (agrees and is_confirmed)

    def _is_confirmed(self, moved_m: float, fits: bool) -> bool:
        """Whether the start pose is confirmed, or none has to be."""
        if self._trial is None:
            return True
        self._trial.add(moved_m, fits)
        if self._trial.is_passed:
            self._trial = None
        return self._trial is None

    def _end_look(self, seen_through: float) -> None:
        """Set the evidence of walls that were seen through before the present look."""
        self._before_look = seen_through
        self._seen_through = seen_through
        if seen_through == 0.0:
            self._opening = _Opening()

    def place(self, is_map_given: bool = False) -> None:
        """The pose was given: the robot is delocalized until scans fit.

        is_map_given: the map does not change: the robot is also lost until the first scan that
        fits. Outside of the map no scan contradicts it.
        """
        self.is_delocalized = True
        self._trial = None
        self.is_unconfirmed = False
        self.level = _UNCONFIRMED_EVIDENCE if is_map_given else 0.0
        self._end_look(0.0)

    def start_delocalized(self, is_pose_given: bool = True, is_guess: bool = False) -> None:
        """Start in a loaded map; is_pose_given: one scan that fits confirms the pose.

        is_guess: the robot may be anywhere; scans that fit on the way confirm it.
        """
        self.is_delocalized = True
        self._trial = None if is_pose_given and not is_guess else _Trial(is_guess)
        self.level = self._loaded_evidence

    def lose(self) -> None:
        """The robot is delocalized in the map as it is, until scans fit."""
        self.is_delocalized = True
        self.level = min(self.level, self._lost_evidence)
        self._end_look(0.0)

    def start_submap(self) -> None:
        """Start a new local map, which no scan contradicts."""
        self.level = 0.0
        self._is_foreign = False
        self._end_look(0.0)
        self._trial = None
        self.is_delocalized = False


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
    scan that was last added to the map, None before the first. evidence: against the map.
    """

    def __init__(self, config: LocalizerConfig) -> None:
        self._config = config
        self._matcher = Matcher(config.matching)
        self.prediction = OdometryPrediction(config.odometry)
        start = se2.pose(config.initial_x_m, config.initial_y_m, config.initial_yaw_rad)
        self.T_anchor_base = start
        self.uncertainty = PoseUncertainty(start)
        self.evidence = MapEvidence(config.lost_threshold, config.matching.min_inlier_ratio)
        self.reckoned = DeadReckoning(start, np.zeros((3, 3)))
        self.T_anchor_update: Array | None = None

    def adjust(self, config: LocalizerConfig) -> None:
        """Continue with other values of `LIVE_PARAMETERS`."""
        self._config = config
        self._matcher = Matcher(config.matching)
        self.evidence.adjust(config.lost_threshold, config.matching.min_inlier_ratio)

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
        try:
            return self._measure(scan, points, prediction, is_stationary, there)
        except Exception:
            self.T_anchor_base = prediction.prior
            self.uncertainty.coast(prediction.prior, prediction.covariance, is_stationary)
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
        before = prediction.before
        match = self._match(scan, points, prediction.prior, there)
        moved_m = 0.0 if is_stationary else float(np.hypot(*(prediction.prior - before)[:2]))
        through = self._seen_through(scan, match, there)
        self.evidence.update(match, through, is_stationary, moved_m)
        own = None if match is None else match.seen_from(there.anchor.T_map)
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
        if self.evidence.agrees:
            self.reckoned = DeadReckoning(self.T_anchor_base, self.uncertainty.since_match)

    def _is_stationary(self, prediction: Prediction) -> bool:
        """Whether the robot has moved by no more than the odometry noise."""
        slip = BOUND_SIGMAS * odometry_slip(self._config.odometry)
        is_still = self.uncertainty.is_stationary(prediction.prior, slip)
        return prediction.motion.is_stationary and is_still

    def _match(self, scan: Scan, points: Array, prior: Array, there: Surroundings) -> Match | None:
        """Match a scan with the local map; None if scan or map have too little structure."""
        if len(points) < MIN_POINTS or there.local_map.is_empty:
            return None
        if np.ptp(points[:, :2], axis=0).max() < self._config.local_map.resolution_m:
            return None  # all points in one cell do not determine a pose
        T_map = there.anchor.T_map
        covariance = rotated_covariance(self.uncertainty.since_match, float(T_map[2]))
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
        is_given = self.evidence.is_delocalized
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
        if match is not None and is_unexpected and not self.evidence.is_delocalized:
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

        An unexpected match is, if many of its points contradict the map. After scans that could
        not be matched, one that fits badly is: a few points fit somewhere within a wide prior.
        """
        if self.evidence.is_delocalized:
            return False
        if is_unexpected and (
            match.inlier_ratio < INLIERS_PER_CONTRADICTION * match.contradiction_ratio
        ):
            return True
        is_wide = self._config.matching.is_wide(self.uncertainty.since_match)
        return self.evidence.is_unconfirmed and is_wide

    def _blind_reason(
        self, scan: Scan, points: Array, match: Match | None, there: Surroundings
    ) -> str:
        """Why the laser does not confirm the pose; '' if it does, or if no wall is in range."""
        if match is not None or scan.is_blind:
            return scan.blind_reason
        has_confirmed = not self._config.is_mapping or there.has_keyframes
        is_confirmed = has_confirmed and not self.evidence.is_delocalized
        sparse_reason = few_beams_reason(scan) or _sparse_reason(scan, points, is_confirmed)
        if sparse_reason or there.is_apart or self.evidence.is_lost:
            return sparse_reason
        T_map_base = there.anchor.pose(self.T_anchor_base)
        covariance = self.uncertainty.since_match
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
