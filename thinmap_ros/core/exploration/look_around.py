"""A full turn in place, before an exploration gives up beside unknown space."""

import math

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.exploration.belief import WORTH_SEEING_M2, Evidence
from thinmap_ros.core.exploration.candidates import Candidate
from thinmap_ros.core.se2 import Array

# Of the place where the robot turns; the end nodes' ids are below.
TURN_ID = 2**32 - 1
# With two parts, both ways to the next heading would be of the same length.
_PARTS = 3
_IS_THERE_RAD = 0.35


class LookAround:
    """One full turn in place, if it can show anything.

    At its start, a robot whose laser does not see all round may stand where it has not seen enough
    free space to drive to. is_in_the_dark: whether more is hidden around it than is known.
    """

    def __init__(self) -> None:
        self.is_in_the_dark = False
        self._was_tried = False
        self._goals: list[Array] = []

    def next_goal(
        self, T_map_base: Array, hidden_m2: float, known_m2: float, is_left: bool
    ) -> Array | None:
        """Where to turn from a pose (3,), as a pose (3,); None: no more, or no use.

        hidden_m2: unknown area in line of sight of the robot, were it to look there; known_m2: of
        the map; is_left: whether end nodes are left.
        """
        self.is_in_the_dark = hidden_m2 > known_m2
        is_of_use = self.is_in_the_dark or (is_left and hidden_m2 >= WORTH_SEEING_M2)
        if is_of_use and not self._was_tried:
            x, y, theta = T_map_base.tolist()
            part = 2.0 * math.pi / _PARTS
            self._goals = [se2.pose(x, y, theta + k * part) for k in range(1, _PARTS + 1)]
        self._was_tried = True
        while self._goals and _has_heading(T_map_base, self._goals[0]):
            self._goals.pop(0)
        return self._goals[0] if self._goals else None

    def stop(self) -> None:
        """End a turn: it has shown where to drive, or is not possible."""
        self._goals = []


def turn_target(goal: Array) -> Candidate:
    """The place (3,) where the robot turns, as a target: it has no frontier of its own."""
    place = float(goal[0]), float(goal[1])
    nothing = np.zeros((0, 2), dtype=np.int64)
    return Candidate(Evidence(TURN_ID, place), nothing, place, goal=goal)


def _has_heading(T_map_base: Array, goal: Array) -> bool:
    return abs(se2.wrap(float(goal[2] - T_map_base[2]))) <= _IS_THERE_RAD
