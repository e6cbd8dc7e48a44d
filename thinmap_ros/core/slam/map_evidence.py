"""Evidence against the map: scans agree with it, the robot is lost, or it is delocalized."""

from thinmap_ros.core.slam.matching.scan_matcher import Match

# Inliers for each contradicting point with which a match overrides the odometry.
INLIERS_PER_CONTRADICTION = 3.0
# Ratio of returns behind walls, between that of the worst real log (mean 0.11, of an office with
# much glass) and that of robots that were kidnapped (mean 0.4 in the first seconds).
_SEEN_THROUGH = 0.25
# Of a pose that no scan has confirmed: less than a scan with 30 % inliers removes.
_UNCONFIRMED_EVIDENCE = 0.3 / INLIERS_PER_CONTRADICTION


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
        self._is_foreign = False  # whether the last scan may be one of another place
        self.is_delocalized = False  # in a loaded map, or after set_pose, until scans fit
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
        return self.is_delocalized and not self.agrees

    @property
    def needs_submap(self) -> bool:
        """Whether the evidence against the map, or against a given pose, reaches the threshold."""
        return max(self.level, self._seen_through) >= self._lost_evidence

    def update(
        self, match: Match | None, seen_through: float = 0.0, is_stationary: bool = False
    ) -> None:
        """Update the evidence by a match; None (no match was possible) leaves it unchanged.

        seen_through: ratio of returns behind walls of the map; is_stationary: whether the scan is
        of the same look as the last one, and no evidence of its own.
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
        self._seen_through = max(self._before_look + seen_through - _SEEN_THROUGH, 0.0)
        if self.is_delocalized:
            self.level = min(self.level, self._lost_evidence)
            self.is_delocalized = not self.agrees or match.inlier_ratio < self._least_fit

    def _end_look(self, seen_through: float) -> None:
        """Set the evidence of walls that were seen through before the present look."""
        self._before_look = seen_through
        self._seen_through = seen_through

    def place(self, is_map_given: bool = False) -> None:
        """The pose was given: the robot is delocalized until scans fit.

        is_map_given: the map does not change: the robot is also lost until the first scan that
        fits. Outside of the map no scan contradicts it.
        """
        self.is_delocalized = True
        self.is_unconfirmed = False
        self.level = _UNCONFIRMED_EVIDENCE if is_map_given else 0.0
        self._end_look(0.0)

    def start_delocalized(self) -> None:
        """Start in a loaded map, at an unconfirmed pose."""
        self.is_delocalized = True
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
        self.is_delocalized = False
