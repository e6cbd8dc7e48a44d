"""How uncertain the pose is: since scans last fitted, since the map last grew, since the anchor.

A scan measures the pose in the local map. The map errs where it grew, by as much as the scan that
it learned from: that adds up along the path, and only loop closure takes it back.
"""

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import inverse, propagated_covariance, rotated_covariance
from thinmap_ros.core.slam.matching.scan_matcher import Match

CHI2 = 11.34  # 99 % of three degrees of freedom
UNKNOWN = np.diag(np.square([300.0, 300.0, np.pi]))  # of a pose that could be anywhere
_LEAST_STEP = np.diag(np.square([2e-3, 2e-3, 5e-4]))  # of a step between keyframes, at least


class Contradiction:
    """What scans have moved the pose by, against the motion, since the anchor."""

    def __init__(self) -> None:
        self._moved: Array = np.zeros(3)
        self._expected = np.zeros((3, 3))
        self._known: Array = np.zeros((3, 3))

    def add(self, off: Array, expected: Array) -> None:
        """Add what a match is off (3,) its prior, and the covariance (3, 3) expected of that."""
        self._moved = self._moved + off
        self._expected = self._expected + expected

    def add_jump(self, covariance: Array) -> None:
        """Add a step that is known to be uncertain by a covariance (3, 3)."""
        self._known = self._known + covariance

    @property
    def covariance(self) -> Array:
        """Covariance (3, 3) that the step from the anchor has on top, 0 where nothing disagrees.

        Scans that pull a robot back to what was mapped before, a little each time, are no motion.
        """
        expected = self._expected + _LEAST_STEP
        if float(self._moved @ np.linalg.solve(expected, self._moved)) < CHI2:
            return self._known
        return self._known + np.outer(self._moved, self._moved)


class PoseUncertainty:
    """Covariances (3, 3), map frame, of the pose as seen from several places on its path."""

    def __init__(self, T_map_base: Array) -> None:
        self.since_match = np.zeros((3, 3))  # motion since the last good match: the next prior
        self.since_map_update = np.zeros((3, 3))  # pose since the last map update
        self.motion_part: Array = np.zeros((3, 3))  # of since_map_update, due to the motion
        self._since_keyframe = np.zeros((3, 3))
        self._map_update_covariance = np.zeros((3, 3))  # of the last map update, not yet counted
        self._contradiction = Contradiction()
        self._T_moved = T_map_base  # where the robot was when it last moved

    def place(self, T_map_base: Array, covariance: Array) -> None:
        """The robot is at a pose (3,) with a covariance (3, 3), however it came there."""
        own = 0.5 * (covariance + covariance.T) + _LEAST_STEP
        self._T_moved = T_map_base
        self.since_match = own
        self.since_map_update = own
        self._since_keyframe = np.zeros((3, 3))
        self._map_update_covariance = np.zeros((3, 3))
        self._contradiction.add_jump(own + UNKNOWN)

    def predict(self, before: Array, prior: Array, Q: Array, is_stationary: bool) -> None:
        """The motion has led from one pose (3,) to another, with covariance Q (3, 3)."""
        self.since_match = propagated_covariance(self.since_match, prior[:2] - before[:2]) + Q
        if not is_stationary:
            lever = prior[:2] - self._T_moved[:2]
            self._since_keyframe = propagated_covariance(self._since_keyframe, lever)
            self.since_map_update = propagated_covariance(self.since_map_update, lever)

    def is_stationary(self, T_map_base: Array, slip: Array) -> bool:
        """Whether a pose (3,) is where the robot last moved, but for the slip (3,)."""
        return bool((np.abs(se2.pose_difference(T_map_base, self._T_moved)) <= slip).all())

    def coast(self, T_map_base: Array, Q: Array, is_stationary: bool) -> None:
        """No scan has told the pose: it is where the motion has led."""
        if not is_stationary:
            self.since_map_update = self.since_map_update + Q
            self._T_moved = T_map_base
        self.motion_part = self.since_map_update

    def update(self, match: Match, prior: Array, Q: Array, fits: bool, is_stationary: bool) -> None:
        """A match has told the pose, against a prior (3,); fits: whether it is to be believed."""
        self._contradiction.add(se2.pose_difference(match.T_map_base, prior), self.since_match)
        self.since_match = np.zeros((3, 3)) if fits else match.covariance
        if is_stationary:
            return
        motion_part = inverse(self.since_map_update + Q)
        self.since_map_update = inverse(motion_part + match.scan_information)
        self.motion_part = self.since_map_update @ motion_part @ self.since_map_update
        self._T_moved = match.T_map_base

    def is_unexpected(self, match: Match, prior: Array) -> bool:
        """Whether a match contradicts the motion that led to a prior (3,)."""
        off = se2.pose_difference(match.T_map_base, prior)
        return float(off @ np.linalg.solve(self.since_match, off)) > CHI2

    def learn(self, share: float) -> None:
        """The map has grown; share: of the scan's error that is new since it last did."""
        by_scan = self.by_scan
        self._since_keyframe = self._since_keyframe + self.motion_part + share * by_scan
        self._map_update_covariance = (1.0 - share) * by_scan
        self.since_map_update = np.zeros((3, 3))
        self.motion_part = np.zeros((3, 3))

    @property
    def by_scan(self) -> Array:
        """The part (3, 3) of the pose's error since the map grew that comes of the scan."""
        return self.since_map_update - self.motion_part

    def start_submap(self, T_map_base: Array, covariance: Array) -> None:
        """A new local map begins at a pose (3,), off by a covariance (3, 3) from the old one."""
        self._contradiction.add_jump(covariance)
        self._since_keyframe = self._since_keyframe + covariance
        self.since_match = np.zeros((3, 3))
        self._T_moved = T_map_base

    def step_from(self, yaw: float) -> tuple[Array, Array]:
        """Covariance (3, 3) of the step from an anchor with a heading, and what jumps add to it."""
        jump = self._contradiction.covariance
        step = rotated_covariance(self._since_keyframe, -yaw) + _LEAST_STEP
        return step, rotated_covariance(jump, -yaw)

    def start_step(self) -> None:
        """The pose is that of a keyframe, from which on uncertainty is counted."""
        self._since_keyframe = np.zeros((3, 3))
        self._map_update_covariance = np.zeros((3, 3))
        self._contradiction = Contradiction()

    def move(self, T_map_base: Array) -> None:
        """The pose was corrected to (3,), and all that it is seen from with it."""
        self._T_moved = T_map_base

    def covariance(self, T_anchor: Array | None, anchor_covariance: Array | None) -> Array:
        """Covariance (3, 3) of the pose in the map, by that of its anchor at (3,), if any."""
        # The pose errs as the scan that the map learned from, until it errs by more.
        own = self._since_keyframe + max(
            self._map_update_covariance, self.since_map_update, key=np.trace
        )
        if T_anchor is not None and anchor_covariance is not None:
            own = own + propagated_covariance(anchor_covariance, self._T_moved[:2] - T_anchor[:2])
        return np.asarray(0.5 * (own + own.T))
