"""Headings of the keyframes that wall directions measure, as arrays."""

import math

import numpy as np

from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.pose_graph import EdgeArrays, Systematic
from thinmap_ros.core.slam.graph.rows import Rows
from thinmap_ros.core.slam.wall_compass import Heading, Reference

_UNMEASURED = (0.0, math.inf, 0.0, 0.0, 0.0, 0.0, 0.0)


def heading_row(heading: Heading | None) -> tuple[float, ...]:
    """Yaw; its variance, infinite without one; variance and derivative (4,) of the direction."""
    return _UNMEASURED if heading is None else heading.row


class HeadingTable:
    """The measured headings by keyframe."""

    def __init__(self) -> None:
        self._rows = Rows(7)
        self._parameters = Rows(4)
        self._spans = Rows(dtype=np.int64)

    def append(self, heading: Heading | None) -> None:
        """Add the heading of the next keyframe, or that it has none."""
        self._rows.append(heading_row(heading))
        share = None if heading is None else heading.reference.systematic
        self._parameters.append(0.0 if share is None else share.parameters)
        self._spans.append(0 if share is None else share.spans)

    @property
    def rows(self) -> Array:
        """A row of `heading_row` for each keyframe, (N, 7)."""
        return self._rows.values

    def of(self, number: int) -> Heading | None:
        """Heading of a keyframe; None without one."""
        yaw, variance, of_reference, *by = self._rows.values[number].tolist()
        if not math.isfinite(variance):
            return None
        derivative = np.zeros((3, 4))
        derivative[2] = by
        spans = int(self._spans.values[number])
        share = Systematic(derivative, self._parameters.values[number].copy(), spans)
        return Heading(yaw, variance, Reference(of_reference, share))

    def edges(self, first: float, parameters: Array | None = None) -> EdgeArrays:
        """The headings as edges from the first keyframe, which has a heading, rad.

        As they are, or would be with parameters (N, 4) of the calibration.
        """
        turns = 0.0 if parameters is None else self._turns(parameters)
        yaws = self.rows[:, 0] + turns
        numbers = 1 + np.flatnonzero(np.isfinite(self.rows[1:, 1]))
        rows = self.rows[numbers]
        T = np.zeros((len(rows), 3))
        T[:, 2] = yaws[numbers] - first
        information = np.zeros((len(rows), 3, 3))
        information[:, 2, 2] = 1.0 / (rows[:, 1] + rows[:, 2])
        return EdgeArrays(
            np.zeros_like(numbers), numbers, T, information, np.ones(len(rows), dtype=np.bool_)
        )

    def _turns(self, parameters: Array) -> Array:
        """Turn (N,) of each heading with parameters (N, 4), by the number of spans, rad."""
        by = parameters[self._spans.values] - self._parameters.values
        return np.asarray(np.einsum('ki,ki->k', self.rows[:, 3:], by))

    def calibrate(self, parameters: Array) -> None:
        """Correct the headings by parameters (N, 4) of the calibration, by the number of spans."""
        self.rows[:, 0] += self._turns(parameters)
        self._parameters.values[:] = parameters[self._spans.values]
