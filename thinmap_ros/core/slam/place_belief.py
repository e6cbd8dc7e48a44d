"""The belief of place: log odds that the robot is where the map has it.

Nats, one number: `SURE` where nothing contradicts the map, 0 where the robot is as likely anywhere
else. Drawing, holding, leaving the map and coming back are thresholds of it.
"""

import math

import numpy as np

from thinmap_ros.core.places.place_odds import SURE
from thinmap_ros.core.places.views import WINDOW_M
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.matching.scan_matcher import Match
from thinmap_ros.core.slam.matching.visibility import MOST_SEEN_THROUGH, NOTHING, SeenThrough

_GIVEN = math.log(1e2)  # of a start pose that a user gave: how rarely it is another one

_LEAST_ODDS = 0.05  # of a kidnapping, that are followed up: a crowd passes

# Inliers for each contradicting point with which a match overrides the odometry.
INLIERS_PER_CONTRADICTION = 3.0

_OPENING_RADIUS_M = 1.5  # a gate for hospital beds, or two leaves of an automatic door

_OPENING_PATH_M = 4.0  # of a robot that drives up to an opening and through it

_LOADED_EVIDENCE = 0.5  # in a loaded map, at first: one or two fitting scans remove it

# Of a pose that no scan has confirmed: less than a scan with 30 % inliers removes.
_UNCONFIRMED_EVIDENCE = 0.3 / INLIERS_PER_CONTRADICTION


class _Trial:
    """A start pose in a map: it is confirmed by scans that fit over the path of a view.

    Some scans fit anywhere, and a map that they change soon agrees with all that follow. Of 20
    starts elsewhere in generated buildings, 13 were mapped at a wrong pose without a trial, 3 with
    one of 1.5 m or of 3 m, and none with this. One that a user gave has odds of its own: the first
    scan that fits confirms it, unless the looks speak against it.
    """

    def __init__(self, is_guess: bool, log_odds: float = 0.0) -> None:
        """is_guess: whether the robot is lost until the pose is confirmed.

        log_odds: of the pose; 0 where nobody gave it.
        """
        self.is_guess = is_guess
        self.is_given = log_odds > 0.0
        self.log_odds = log_odds
        self.is_judged = False
        self._path_m = 0.0
        self._fitting_m = 0.0  # path since a scan did not fit

    def add(self, moved_m: float, fits: bool) -> None:
        """Add a scan that was made after some more path; fits: whether it agrees with the map."""
        self._path_m += moved_m
        self._fitting_m = self._fitting_m + moved_m if fits else 0.0

    @property
    def is_passed(self) -> bool:
        """Whether the pose is confirmed."""
        return self._fitting_m > WINDOW_M or (self.is_judged and self.log_odds >= _GIVEN)

    @property
    def is_failed(self) -> bool:
        """Whether the odds are against it, or no view confirmed it where there was room for two."""
        return not self.is_passed and (self._path_m > 2.0 * WINDOW_M or self.log_odds < 0.0)


class _Opening:
    """Whether one opening explains what is seen through: a door, or a cupboard that is gone.

    A kidnapped robot sees through walls all around. One that waits before an automatic door
    and then drives through it sees through that alone, with most of its beams for some metres.
    """

    def __init__(self) -> None:
        self._centre: Array | None = None
        self._within = 0.0  # sums of ratios of returns, since there is evidence
        self._beside = 0.0
        self._path_m = 0.0

    @property
    def explains_most(self) -> bool:
        """Whether most of what was seen through since there is evidence is within one opening."""
        return self._within > self._beside and self._path_m < _OPENING_PATH_M

    def add(self, seen: SeenThrough, moved_m: float) -> None:
        """Add what a scan sees through that was made after some more path."""
        self._path_m += moved_m
        if not len(seen.walls):
            return
        if self._centre is None:
            self._centre = np.median(seen.walls, axis=0)
        is_beside = np.hypot(*(seen.walls - self._centre).T) > _OPENING_RADIUS_M
        beside = seen.ratio * float(np.mean(is_beside))
        self._beside += beside
        self._within += seen.ratio - beside


class PlaceBelief:
    """Log odds that the robot is where the map has it, from each scan that is tracked.

    Two CUSUM tests detect that scans contradict the map. The level sums up the contradiction ratio
    less a third of the inlier ratio, and is never negative. A map that grows soon fits wherever the
    robot is: the walls that are seen through are evidence of their own, which no inlier reduces.
    What a scan shows of the previous one needs no map at all.
    Source: Page, "Continuous inspection schemes", 1954.
    """

    def __init__(self, lost_threshold: float, least_fit: float) -> None:
        self.is_unconfirmed = False  # after a scan without a match, until one fits
        self.adjust(lost_threshold, least_fit)
        self.start_submap()

    def _begin(self, level: float, trial: _Trial | None = None) -> None:
        """Begin delocalized, with evidence against the map; trial: of the pose, if there is one."""
        self.is_delocalized = True  # in a loaded map, or after set_pose, until scans fit
        self._trial = trial
        self.level = level
        self._carried = 0.0  # odds of a kidnapping by the last motion
        self._is_elsewhere = False  # it was kidnapped before
        self._is_held = False  # nothing is drawn, as it may have been
        self._end_look(0.0)

    def _end_look(self, seen_through: float) -> None:
        """Set the evidence of walls that were seen through before the present look."""
        self._before_look = seen_through
        self._seen_through = seen_through  # up to now
        if seen_through == 0.0:
            self._opening = _Opening()

    def adjust(self, lost_threshold: float, least_fit: float) -> None:
        """Set the evidence at which the robot is lost, and the inlier ratio of a scan that fits."""
        self._lost_evidence = lost_threshold
        self._least_fit = least_fit

    @property
    def log_odds(self) -> float:
        """Log odds that the robot is where the map has it."""
        seen_through = SURE * (1.0 - self._seen_through / self._lost_evidence)
        return min(self._log_odds_of_level, seen_through)

    @property
    def agrees(self) -> bool:
        """Whether there is no evidence against the map."""
        return self.level == 0.0 and self._seen_through == 0.0 and self._carried == 0.0

    @property
    def permits_mapping(self) -> bool:
        """Whether scans agree with the map, and do so at a pose that is given or confirmed."""
        return self.agrees and self._trial is None

    @property
    def forbids_mapping(self) -> bool:
        """Whether the last scan may show another place than the map does.

        A map that such scans change soon agrees with them, wherever the robot is. A scan that fits
        shows this place, with people or furniture, unless the robot may have been kidnapped.
        """
        return self._is_foreign or self._is_held

    @property
    def _is_grave(self) -> bool:
        """Whether the evidence is more than half of what makes the robot lost."""
        return 2.0 * max(self.level, self._seen_through) > self._lost_evidence

    @property
    def is_lost(self) -> bool:
        """Whether scans have not confirmed the pose at which the robot was placed in the map."""
        trial = self._trial
        is_doubtful = trial is not None and (trial.is_guess or trial.log_odds < 0.0)
        return self.is_delocalized and (is_doubtful or not self.agrees)

    @property
    def needs_submap(self) -> bool:
        """Whether the evidence against the map, or against a given pose, reaches the threshold."""
        if self.is_elsewhere or (self._trial is not None and self._trial.is_failed):
            return True
        if self.level >= self._lost_evidence:
            return True
        return self._seen_through >= self._lost_evidence and not self._opening.explains_most

    def move(self, continuity: float, is_again: bool = False) -> None:
        """Update the belief by a motion after which the robot may be anywhere.

        continuity: log likelihood ratio that it was not kidnapped, at most 0; is_again: since the
        same scan as the last one, which it then replaces. An event, and no further evidence of what
        was before: its odds are added, where those are multiplied.
        """
        if self._carried > 0.0 and not is_again:
            self._is_elsewhere = self.is_elsewhere
            self.level = self._lost_evidence * (1.0 - self._log_odds_of_level / SURE)
        odds = math.exp(-SURE) * math.expm1(-continuity)
        self._carried = 0.0 if odds < _LEAST_ODDS or self.is_delocalized else odds
        # Places that look alike differ in what is around them, which is to be compared yet.
        is_doubtful = self._is_held or self._carried > 0.0
        self._is_held = is_doubtful and 2.0 * self.log_odds < SURE

    @property
    def is_doubted(self) -> bool:
        """Whether the robot may have been kidnapped by the last motion."""
        return self._carried > 0.0

    @property
    def is_elsewhere(self) -> bool:
        """Whether the robot was kidnapped."""
        return self._is_elsewhere or (self._carried > 0.0 and self._log_odds_of_level <= 0.0)

    @property
    def _log_odds_of_level(self) -> float:
        """Log odds by the level and the last motion."""
        log_odds = SURE * (1.0 - self.level / self._lost_evidence)
        if self._carried == 0.0:
            return log_odds
        return -float(np.logaddexp(-log_odds, math.log(self._carried)))

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
        if self.is_elsewhere:
            # At rest it may be put back.
            self.level += 0.0 if is_stationary else match.contradiction_ratio
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
        self._seen_through = max(self._before_look + seen_through.ratio - MOST_SEEN_THROUGH, 0.0)
        if self._seen_through > 0.0:
            self._opening.add(seen_through, moved_m)
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

    def place(self, is_map_given: bool = False, is_tried: bool = True) -> None:
        """The pose was given: the robot is delocalized until scans fit, and looks do not deny it.

        is_map_given: the map does not change: the robot is also lost until the first scan that
        fits. Outside of the map no scan contradicts it. is_tried: whether looks on the path may
        deny it, and the map waits for them; else one scan that fits confirms it.
        """
        trial = _Trial(is_guess=False, log_odds=_GIVEN) if is_tried else None
        self._begin(_UNCONFIRMED_EVIDENCE if is_map_given else 0.0, trial)
        self.is_unconfirmed = False

    @property
    def is_start_judged(self) -> bool:
        """Whether a pose that was given waits for looks that speak for it."""
        return self._trial is not None and self._trial.is_given

    def judge_start(self, log_ratio: float) -> None:
        """Add the log likelihood ratio of a look from another place to a given pose.

        One place alone, with people around, does not outweigh the pose.
        """
        assert self._trial is not None
        self._trial.log_odds += max(log_ratio, -0.75 * _GIVEN)
        self._trial.is_judged = True

    def start_delocalized(
        self, is_pose_given: bool = True, is_guess: bool = False, is_tried: bool = False
    ) -> None:
        """Start in a loaded map; is_pose_given: one scan that fits confirms the pose.

        is_guess: the robot may be anywhere; scans that fit on the way confirm it; is_tried: the
        pose was given, and is judged by `judge_start`.
        """
        trial = None if is_pose_given and not is_guess else _Trial(is_guess)
        if is_tried:
            trial = _Trial(is_guess=False, log_odds=_GIVEN)
        self._begin(_LOADED_EVIDENCE, trial)

    def lose(self) -> None:
        """The robot is delocalized in the map as it is, until scans fit."""
        self._begin(self._lost_evidence)

    def start_submap(self) -> None:
        """Start a new local map, which no scan contradicts."""
        self._begin(0.0)
        self._is_foreign = False  # whether the last scan may be one of another place
        self.is_delocalized = False
