"""The driven path in pieces, of which the last one grows."""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array
from thinmap_ros.web.board import Board

_STEP_M = 0.2
_PIECE = 100  # points


class DrivenPath:
    """Puts the path of the robot on a board: a correction replaces it up to its stamp."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._points: list[tuple[int, float, float]] = []

    @property
    def start(self) -> tuple[float, float] | None:
        """Where the path begins, m; None without a path."""
        return self._points[0][1:] if self._points else None

    def add(self, stamp_ns: int, x: float, y: float) -> None:
        """Add a place, m, unless the robot has hardly moved."""
        if self._points:
            last_ns, last_x, last_y = self._points[-1]
            if math.hypot(x - last_x, y - last_y) < _STEP_M:
                return
            if stamp_ns < last_ns:
                self._points = []  # time was set back
        self._points.append((stamp_ns, x, y))
        # The piece before ends with the first point of the next one.
        self._show(first=max((len(self._points) - 2) // _PIECE, 0))

    def correct(self, stamps_ns: NDArray[np.int64], poses: Array) -> None:
        """Replace the path up to the last of the stamps (N,) by poses (N, 3)."""
        places = poses[:, :2].tolist()
        corrected = [
            (stamp_ns, x, y) for stamp_ns, (x, y) in zip(stamps_ns.tolist(), places, strict=True)
        ]
        end_ns = corrected[-1][0] if corrected else 0
        self._points = corrected + [point for point in self._points if point[0] > end_ns]
        self._show()

    def _show(self, first: int = 0) -> None:
        """Show the pieces from the first that has changed on."""
        starts = range(0, len(self._points), _PIECE)
        self._board.keep('path/', {f'path/{start // _PIECE}' for start in starts})
        for start in starts[first:]:
            # A point more, so that no gap is between two pieces.
            part = self._points[start : start + _PIECE + 1]
            xy = [round(number, 2) for _, x, y in part for number in (x, y)]
            self._board.put(f'path/{start // _PIECE}', xy)
        self._board.put('path', len(starts))
