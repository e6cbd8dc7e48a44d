"""Covariance of the pose since the last match, the last map update, and the anchor keyframe.

A match measures the pose relative to the local map. A scan that is added to the map adds its own
pose error to it. These errors accumulate along the path until a loop closure corrects them.

The systematic error of the odometry is one error in all steps. Where the scans do not measure the
pose, it adds up along the path: the covariance is P + S C S', with P of independent errors, C of
the calibration, and S the derivative of the pose by it.
"""

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import (
    Array,
    carried,
    inverse,
    propagated_covariance,
    rotated_covariance,
    rotation,
)
from thinmap_ros.core.slam.matching.scan_matcher import Match

CHI2 = 11.34  # 99 % of three degrees of freedom
UNKNOWN = np.diag(np.square([300.0, 300.0, np.pi]))  # covariance of an unknown pose
_NO_DERIVATIVE = np.zeros((3, 4))
_MIN_STEP = np.diag(np.square([2e-3, 2e-3, 5e-4]))  # smallest covariance between keyframes


class Contradiction:
    """Sum of the innovations of matches since the anchor: pose changes that are no motion."""

    def __init__(self) -> None:
        self._moved: Array = np.zeros(3)
        self._expected = np.zeros((3, 3))
        self._known: Array = np.zeros((3, 3))

    def add(self, off: Array, expected: Array) -> None:
        """Add the innovation (3,) of a match, and the prior covariance (3, 3) of it."""
        self._moved = self._moved + off
        self._expected = self._expected + expected

    def add_jump(self, covariance: Array) -> None:
        """Add the covariance (3, 3) of a known discontinuity."""
        self._known = self._known + covariance

    @property
    def covariance(self) -> Array:
        """Covariance (3, 3) to add to the step from the anchor; 0 if the innovations are noise.

        Many small innovations in one direction pull the pose onto an earlier map; they are no
        motion of the robot.
        """
        expected = self._expected + _MIN_STEP
        if float(self._moved @ np.linalg.solve(expected, self._moved)) < CHI2:
            return self._known
        return self._known + np.outer(self._moved, self._moved)


class PoseUncertainty:
    """Covariances (3, 3), frame of the anchor, of the pose relative to several earlier poses.

    T_moved: pose (3,) after the last motion, relative to the anchor.
    """

    def __init__(self, T_anchor_base: Array) -> None:
        self.since_match = np.zeros((3, 3))  # motion since the last good match: the next prior
        self.since_map_update = np.zeros((3, 3))  # pose since the last map update
        self.motion_part: Array = np.zeros((3, 3))  # share of since_map_update from the motion
        self._since_keyframe = np.zeros((3, 3))
        self._map_update_covariance = np.zeros((3, 3))  # last update, not in _since_keyframe
        # Since the walls in view were drawn, which matches measure; and besides, from the anchor.
        self._systematic_in_view = _NO_DERIVATIVE
        self._systematic_of_step = _NO_DERIVATIVE
        self._contradiction = Contradiction()
        self.T_moved = T_anchor_base

    def place(self, T_anchor_base: Array, covariance: Array) -> None:
        """Set the pose (3,) and its covariance (3, 3), without any motion."""
        own = 0.5 * (covariance + covariance.T) + _MIN_STEP
        self.T_moved = T_anchor_base
        self.since_match = own
        self.since_map_update = own
        self._since_keyframe = np.zeros((3, 3))
        self._map_update_covariance = np.zeros((3, 3))
        self._systematic_in_view = _NO_DERIVATIVE
        self._systematic_of_step = _NO_DERIVATIVE
        self._contradiction.add_jump(own + UNKNOWN)

    def predict(
        self, before: Array, prior: Array, Q: Array, is_stationary: bool, by_calibration: Array
    ) -> None:
        """Propagate by a motion from a pose (3,) to the prior (3,), with covariance Q (3, 3).

        by_calibration (3, 4): derivative of the motion by the calibration.
        """
        self.since_match = propagated_covariance(self.since_match, prior[:2] - before[:2]) + Q
        if not is_stationary:
            lever = prior[:2] - self.T_moved[:2]
            self._since_keyframe = propagated_covariance(self._since_keyframe, lever)
            self.since_map_update = propagated_covariance(self.since_map_update, lever)
            self._systematic_of_step = carried(self._systematic_of_step, lever)
            self._systematic_in_view = carried(self._systematic_in_view, lever) + by_calibration

    def is_stationary(self, T_anchor_base: Array, slip: Array) -> bool:
        """Whether a pose (3,) differs from the last moved one by at most the slip (3,)."""
        return bool((np.abs(se2.pose_difference(T_anchor_base, self.T_moved)) <= slip).all())

    def coast(self, T_anchor_base: Array, Q: Array, is_stationary: bool) -> None:
        """Use the predicted pose (3,) of this step, without a match."""
        if not is_stationary:
            self.since_map_update = self.since_map_update + Q
            self.T_moved = T_anchor_base
        self.motion_part = self.since_map_update

    def update(self, match: Match, prior: Array, Q: Array, fits: bool, is_stationary: bool) -> None:
        """Update by a match with a prior (3,); fits: whether enough points are inliers."""
        self._contradiction.add(se2.pose_difference(match.pose, prior), self.since_match)
        self.since_match = np.zeros((3, 3)) if fits else match.covariance
        if is_stationary:
            return
        motion_part = inverse(self.since_map_update + Q)
        self.since_map_update = inverse(motion_part + match.scan_information)
        unmeasured = self.since_map_update @ motion_part  # share of the prior: I - K
        self.motion_part = unmeasured @ self.since_map_update
        self._systematic_in_view = unmeasured @ self._systematic_in_view
        self.T_moved = match.pose

    def is_unexpected(self, match: Match, prior: Array) -> bool:
        """Whether the innovation of a match from its prior (3,) exceeds the 99 % gate."""
        off = se2.pose_difference(match.pose, prior)
        return float(off @ np.linalg.solve(self.since_match, off)) > CHI2

    def map_updated(self, share: float) -> None:
        """Account for a map update; share: of the scan's error that is independent of the last.

        It is also the share of the walls in view that the scan draws.
        """
        scan_part = self.scan_part
        self._since_keyframe = self._since_keyframe + self.motion_part + share * scan_part
        self._map_update_covariance = (1.0 - share) * scan_part
        self.since_map_update = np.zeros((3, 3))
        self.motion_part = np.zeros((3, 3))
        drawn = share * self._systematic_in_view
        self._systematic_of_step = self._systematic_of_step + drawn
        self._systematic_in_view = self._systematic_in_view - drawn

    @property
    def scan_part(self) -> Array:
        """Share (3, 3) of `since_map_update` that is due to the scan."""
        return self.since_map_update - self.motion_part

    def start_submap(self, T_anchor_base: Array, covariance: Array) -> None:
        """Start a submap at a pose (3,), with covariance (3, 3) relative to the previous one."""
        self._contradiction.add_jump(covariance)
        self._since_keyframe = self._since_keyframe + covariance
        self.since_match = np.zeros((3, 3))
        self.T_moved = T_anchor_base

    def step(self) -> tuple[Array, Array]:
        """Covariance (3, 3) of the step from the anchor, and that of its jumps (3, 3)."""
        return self._since_keyframe + _MIN_STEP, self._contradiction.covariance

    def start_step(self, T_old_new: Array) -> None:
        """Make a pose (3,), the current one, the anchor: its step covariance restarts at 0."""
        yaw = -float(T_old_new[2])
        self.T_moved = se2.between(T_old_new, self.T_moved)
        self.since_match = rotated_covariance(self.since_match, yaw)
        self.since_map_update = rotated_covariance(self.since_map_update, yaw)
        self.motion_part = rotated_covariance(self.motion_part, yaw)
        self._since_keyframe = np.zeros((3, 3))
        self._map_update_covariance = np.zeros((3, 3))
        self._systematic_in_view = rotation(yaw) @ self._systematic_in_view
        # What a match takes off the part in view is then taken off the new step.
        self._systematic_of_step = -self._systematic_in_view
        self._contradiction = Contradiction()

    @property
    def systematic(self) -> Array:
        """Derivative (3, 4) of the pose relative to the anchor by the calibration."""
        return self._systematic_of_step + self._systematic_in_view

    @property
    def since_anchor(self) -> Array:
        """Covariance (3, 3) of the independent errors of the pose relative to the anchor."""
        # A match cannot be more accurate than the scan that was last added to the map.
        return self._since_keyframe + max(
            self._map_update_covariance, self.since_map_update, key=np.trace
        )
