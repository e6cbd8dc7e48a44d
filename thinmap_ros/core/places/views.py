"""Views of a piece of map: the scans of some metres of path as one cloud of points."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import kernel


@kernel
def passed_cells(
    poses: Array, ranges: Array, bearings: Array, cell_m: float, half: int
) -> NDArray[np.bool_]:
    """Which cells of a lattice (2 half, 2 half) around the origin the beams of scans pass.

    poses (K, 3): of the lasers; ranges (K, B): as far as the beams are free, m, NaN for none;
    bearings (K, B): rad, frame of the laser.
    """
    passed = np.zeros((2 * half, 2 * half), dtype=np.bool_)
    for k in range(len(poses)):
        for i in range(ranges.shape[1]):
            if not ranges[k, i] > 0.0:
                continue
            angle = poses[k, 2] + bearings[k, i]
            dx = math.cos(angle)
            dy = math.sin(angle)
            x = poses[k, 0] / cell_m
            y = poses[k, 1] / cell_m
            for n in range(int(ranges[k, i] / cell_m) + 1):
                row = int(math.floor(y + n * dy)) + half
                col = int(math.floor(x + n * dx)) + half
                if row < 0 or col < 0 or row >= 2 * half or col >= 2 * half:
                    break
                passed[row, col] = True
    return passed


# One scan is too little for a short-range laser, and a longer path bends with the map.
WINDOW_M = 6.0

SPACING_M = 3.0  # of path between the beginnings of two views

RANGE_M = 12.0  # the error of the heading moves the ends of longer beams

LATTICE_M = 0.2  # of the points and free places that are compared

_MIN_SCANS = 3

_MAX_OFFSET_M = WINDOW_M + RANGE_M  # of a point from the keyframe in the middle


class PlacedScan(Protocol):
    """A keyframe: its scan, surface points (N, 2 or more), robot frame, and its pose (3,)."""

    @property
    def scan(self) -> Scan:
        """The scan."""

    @property
    def points(self) -> Array:
        """Points on walls, robot frame, the first two columns: x, y."""

    @property
    def T_map_base(self) -> Array:  # noqa: N802
        """Pose of the robot in its piece of map."""


@dataclass(frozen=True, eq=False)
class View:
    """Consecutive scans as one cloud, in the frame of the keyframe in the middle.

    walls (N, 2), free (M, 2): points on walls, and free places, m; T_piece_view (3,): pose in the
    piece; frames: numbers of the first, the middle and the last keyframe; path_m: length of the
    path to the middle.
    """

    number: int
    walls: Array
    free: Array
    T_piece_view: Array
    frames: tuple[int, int, int]
    path_m: float


class ViewBuilder:
    """Makes views of keyframes, as these come."""

    def __init__(self) -> None:
        self._frames: list[tuple[int, float, PlacedScan]] = []  # number, path, keyframe
        self._path_m = 0.0
        self._first_m = 0.0  # path at which the first view since the last gap begins
        self._begin_m = 0.0  # and the next one
        self._added = 0
        self._views = 0

    def add(self, frame: PlacedScan) -> list[View]:
        """Add a keyframe; returns the views that are complete with it.

        A keyframe far from the last one begins a new path: the robot came by known ground.
        """
        made: list[View] = []
        if self._frames:
            last = self._frames[-1][2].T_map_base
            step_m = float(np.hypot(*(frame.T_map_base[:2] - last[:2])))
            if step_m > SPACING_M:
                made += self.finish()
            self._path_m += min(step_m, SPACING_M)
        if not self._frames:
            self._first_m = self._path_m
            self._begin_m = self._path_m
        while self._path_m > self._begin_m + WINDOW_M:
            made += self._made()
        self._frames.append((self._added, self._path_m, frame))
        self._added += 1
        return made

    def finish(self) -> list[View]:
        """Make the views at the end of a path."""
        made: list[View] = []
        end_m = self._path_m
        while self._frames:
            if self._begin_m > self._first_m and self._begin_m + SPACING_M > end_m:
                break
            made += self._made()
        self._frames.clear()
        return made

    def _made(self) -> list[View]:
        """The view that begins next, if it has enough scans."""
        end_m = self._begin_m + WINDOW_M
        inside = [frame for frame in self._frames if self._begin_m <= frame[1] <= end_m]
        self._begin_m += SPACING_M
        self._frames = [frame for frame in self._frames if frame[1] >= self._begin_m]
        if len(inside) < _MIN_SCANS:
            return []
        self._views += 1
        return [_view_of(self._views - 1, inside)]


def views_of(frames: Iterable[PlacedScan]) -> list[View]:
    """Views along all keyframes of a piece."""
    builder = ViewBuilder()
    made = [view for frame in frames for view in builder.add(frame)]
    return [*made, *builder.finish()]


def _view_of(number: int, inside: Sequence[tuple[int, float, PlacedScan]]) -> View:
    middle, path_m, frame = inside[len(inside) // 2]
    T_piece_view = frame.T_map_base
    frames = [frame for _, _, frame in inside]
    poses = np.array([se2.between(T_piece_view, frame.T_map_base) for frame in frames])
    return View(
        number,
        _walls(frames, poses),
        _free_places([frame.scan for frame in frames], poses),
        T_piece_view,
        (inside[0][0], middle, inside[-1][0]),
        path_m,
    )


def thinned(points: Array, cell_m: float) -> Array:
    """The mean (M, 2) of the points (N, 2) in each cell of a lattice."""
    cells = np.floor(points / cell_m).astype(np.int64)
    _, owner = np.unique(cells @ np.array([1, 1 << 20]), return_inverse=True)
    count = np.bincount(owner)
    return np.column_stack([np.bincount(owner, points[:, i]) / count for i in (0, 1)])


def _walls(frames: Sequence[PlacedScan], poses: Array) -> Array:
    """Points (N, 2) on walls, the mean of those in each cell of the lattice; poses (K, 3)."""
    clouds = []
    for frame, T in zip(frames, poses, strict=True):
        near = np.hypot(frame.points[:, 0], frame.points[:, 1]) < RANGE_M
        clouds.append(se2.transform_points(T, frame.points[near, :2]))
    return thinned(np.concatenate(clouds), LATTICE_M)


def _free_places(scans: Sequence[Scan], poses: Array) -> Array:
    """Places (M, 2) that beams pass, two cells of the lattice before their ends; poses (K, 3)."""
    beams = max(scan.ranges_m.size for scan in scans)
    ranges = np.full((len(scans), beams), np.nan)
    bearings = np.zeros((len(scans), beams))
    for k, scan in enumerate(scans):
        ends = np.where(scan.hit, scan.ranges_m, np.nan)
        ranges[k, : ends.size] = np.minimum(ends, RANGE_M) - 2.0 * LATTICE_M
        bearings[k, : ends.size] = scan.angles_rad
    lasers = np.array(
        [se2.compose(T, scan.T_base_laser) for T, scan in zip(poses, scans, strict=True)]
    )
    half = round(_MAX_OFFSET_M / LATTICE_M)
    cells = np.argwhere(passed_cells(lasers, ranges, bearings, LATTICE_M, half))
    # Rows as those of a whole map: another order would compile a second variant of a kernel.
    return np.ascontiguousarray((cells[:, ::-1] - half + 0.5) * LATTICE_M)
