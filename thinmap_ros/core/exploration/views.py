"""Views: how much unknown space a robot expects to see from each place that it can reach.

Rays lead from a place over free cells into the unknown. Behind a frontier the laser is expected to
see as far as it does in known space: the unknown at a distance s behind it counts exp(-s / f), with
the mean f of all ranges so far.
"""

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.exploration.space import (
    FrontierMap,
    depth_behind_m,
    field_of_view,
    hidden_area_m2,
    is_enclosed,
)
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.grid.raytrace import axis_setup
from thinmap_ros.core.planning.travel_times import TravelTimes
from thinmap_ros.core.scan import SURE_REACH, Scan
from thinmap_ros.core.se2 import Array, Cells, Mask
from thinmap_ros.jit import kernel

_SPACING_M = 0.6  # of places: at most the width of a robot and of a door
_CLOSE_M = 0.2  # and for the last visit to a frontier: past the edge of a leaf of a door
_RAYS = 90
_RIM_RAD = 0.6  # at the ends of its field of view the laser sees little
_LEAST_FADE_M = 0.5
_MIN_VIEW_M2 = 0.1  # a cell or two at a distance
_SEARCHES = 30  # until a frontier around which nothing changes is examined again
_AROUND_M = 1.0  # of what is in view
_HALF_DIAGONAL = 0.75  # of a cell, and a little more


class Sight:
    """What the laser of a robot sees: its range, its field of view, and the mean of its ranges."""

    def __init__(self) -> None:
        self.range_m = 0.0
        self.slack_rad = 0.0
        self._sum_m = 0.0
        self._count = 0

    def add_scan(self, scan: Scan) -> None:
        """Add the ranges of a scan."""
        low, high = field_of_view(scan)
        self.range_m = scan.range_max_m
        self.slack_rad = max(min(0.5 * (high - low), math.pi) - _RIM_RAD, 0.0)
        self._sum_m += float(scan.ranges_m[scan.hit].sum())
        self._count += int(np.count_nonzero(scan.hit))

    @property
    def fade_m(self) -> float:
        """How far the laser sees into the unknown, on average."""
        return max(self._sum_m / max(self._count, 1), _LEAST_FADE_M)


class View(NamedTuple):
    """What the map shows of a frontier, and from where what it hides is seen.

    hidden_m2: unknown area in line of sight of it; depth_m: of the unknown straight behind it.
    cells (N, 2): of the map, places of the robot; areas_m2 (N,): unknown area behind it that is
    expected in sight from there; directions (N,), rad, map frame: of the middle of that;
    is_enclosed: whether its free cells connect to nowhere that the robot fits, and no place sees
    it.
    """

    hidden_m2: float
    depth_m: float
    cells: Cells
    areas_m2: Array
    directions: Array
    is_enclosed: bool

    @property
    def most_m2(self) -> float:
        """The area in sight of the best place; 0 where none sees behind the frontier."""
        return float(self.areas_m2.max(initial=0.0))


NO_VIEW = View(0.0, 0.0, np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros(0), False)


class ViewFinder:
    """Views of the frontiers of a growing map.

    A frontier is examined again at once where it, or a cell near what is in view, has changed; the
    others in turn, as places far away may come into view.
    """

    def __init__(self) -> None:
        self._frame = GridFrame(0.0, 0.0, 1.0)
        self._known: dict[tuple[bytes, bool], View] = {}

    def update(
        self,
        frontiers: FrontierMap,
        travel: TravelTimes,
        clusters: list[Cells],
        sight: Sight,
        are_last: list[bool],
    ) -> list[View]:
        """View of each frontier of some cells (N, 2), from the places that the robot can reach.

        are_last: which of them are visited for the last time. These may be in sight of a few places
        only, as past the edge of a leaf of a door: more places are examined.
        """
        if self._frame != frontiers.frame:
            self._frame = frontiers.frame
            self._known = {}
        # In the order in which they were examined.
        for key in list(self._known)[: math.ceil(len(self._known) / _SEARCHES)]:
            del self._known[key]
        changed = frontiers.take_changes()
        margin = round(_AROUND_M / frontiers.frame.resolution)
        known: dict[tuple[bytes, bool], View] = {}
        cluster_bytes = (cells.tobytes() for cells in clusters)
        keys = list(zip(cluster_bytes, are_last, strict=True))
        for key, cells in zip(keys, clusters, strict=True):
            view = self._known.get(key)
            if view is not None and not changed[_around(cells, view.cells, margin)].any():
                known[key] = view
        missing = [k for k, key in enumerate(keys) if key not in known]
        if missing:
            examiner = _Examiner(frontiers, travel, clusters, sight)
            known |= {keys[k]: examiner.view(k, are_last[k]) for k in missing}
        self._known = known
        return [known[key] for key in keys]


def _around(cells: Cells, places: Cells, margin: int) -> tuple[slice, slice]:
    """Rows and columns around a frontier (N, 2) and the places (M, 2) that see it."""
    both = np.concatenate([cells, places])
    top, left = both.min(axis=0).tolist()
    bottom, right = both.max(axis=0).tolist()
    rows = slice(max(top - margin, 0), bottom + margin + 1)
    return rows, slice(max(left - margin, 0), right + margin + 1)


class _Examiner:
    """Examines frontiers (N, 2) of a map as it is now."""

    def __init__(
        self, frontiers: FrontierMap, travel: TravelTimes, clusters: list[Cells], sight: Sight
    ) -> None:
        resolution = frontiers.frame.resolution
        self._frontiers = frontiers
        self._clusters = clusters
        self._reach = (sight.range_m / resolution, sight.fade_m / resolution)
        self._owner = np.full(frontiers.free.shape, -1, dtype=np.int32)
        for k, cells in enumerate(clusters):
            self._owner[cells[:, 0], cells[:, 1]] = k
        self._travel = travel

    @cached_property
    def _places(self) -> Cells:
        return self._places_each(_SPACING_M)

    @cached_property
    def _close_places(self) -> Cells:
        return self._places_each(_CLOSE_M)

    def _places_each(self, spacing_m: float) -> Cells:
        stands = self._travel.reachable & self._frontiers.free
        size = max(round(spacing_m / self._frontiers.frame.resolution), 1)
        return _first_reached(self._travel.seconds, stands, size)

    def view(self, k: int, is_last: bool) -> View:
        """View of frontier k."""
        frontiers = self._frontiers
        cells = self._clusters[k]
        known = (frontiers.free, frontiers.passable)
        places = self._close_places if is_last else self._places
        areas, sums = _areas(known, self._owner, k, cells, places, self._reach)
        areas_m2 = areas * frontiers.frame.resolution**2
        seen = areas_m2 >= _MIN_VIEW_M2
        return View(
            hidden_area_m2(frontiers, frontiers.middle_of(cells)),
            depth_behind_m(frontiers, cells),
            places[seen],
            areas_m2[seen],
            np.arctan2(sums[seen, 1], sums[seen, 0]),
            not seen.any() and is_enclosed(frontiers.free, cells, self._travel.allowed),
        )


@kernel
def _first_reached(seconds: NDArray[np.float32], stands: Mask, size: int) -> Cells:
    """The cell that is reached first of each square of size x size cells (H, W) in which one is."""
    rows, cols = seconds.shape
    found = np.empty(((rows // size + 1) * (cols // size + 1), 2), dtype=np.int64)
    count = 0
    for top in range(0, rows, size):
        for left in range(0, cols, size):
            best = np.inf
            for r in range(top, min(top + size, rows)):
                for c in range(left, min(left + size, cols)):
                    if stands[r, c] and seconds[r, c] < best:
                        best = seconds[r, c]
                        found[count] = r, c
            count += best < np.inf
    return found[:count].copy()


def sees_walls(frontiers: FrontierMap, places: Cells, sight: Sight) -> Mask:
    """Whether a wall, which tells a robot its place, is in range from each place (N, 2)."""
    reach = SURE_REACH * sight.range_m / frontiers.frame.resolution
    return _near_walls(frontiers.passable, places, reach)


@kernel
def _near_walls(passable: Mask, places: Cells, reach: float) -> Mask:
    """Whether a cell within reach of each place (N, 2) is not passable, (N,)."""
    rows, cols = passable.shape
    size = int(reach)
    found = np.zeros(len(places), dtype=np.bool_)
    for i in range(len(places)):
        row, col = places[i]
        for r in range(max(row - size, 0), min(row + size + 1, rows)):
            half = int(math.sqrt(reach * reach - (r - row) * (r - row)))
            for c in range(max(col - half, 0), min(col + half + 1, cols)):
                if not passable[r, c]:
                    found[i] = True
                    break
            if found[i]:
                break
    return found


@kernel
def _areas(
    known: tuple[Mask, Mask],
    owner: NDArray[np.int32],
    frontier: int,
    edge: Cells,
    places: Cells,
    reach: tuple[float, float],
) -> tuple[Array, Array]:
    """Unknown area, cells, in sight of places (N, 2) behind a frontier, (N,).

    known: free and passable cells (H, W); owner (H, W): number of the frontier of a cell, else -1;
    edge (M, 2): cells of this one; reach: of the laser, and into the unknown on average. Also the
    sum of the directions (x, y) in which the area lies, (N, 2). Only rays towards the edge are
    cast.
    """
    areas = np.zeros(places.shape[0])
    sums = np.zeros((places.shape[0], 2))
    top = edge[:, 0].min() - reach[0]
    bottom = edge[:, 0].max() + reach[0]
    left = edge[:, 1].min() - reach[0]
    right = edge[:, 1].max() + reach[0]
    is_wanted = np.zeros(_RAYS, dtype=np.bool_)
    part = 2.0 * math.pi / _RAYS
    for i in range(places.shape[0]):
        row, col = places[i]
        if not (top < row < bottom and left < col < right):
            continue
        is_wanted[:] = False
        _aim(row, col, edge, reach[0], is_wanted)
        for k in range(_RAYS):
            if is_wanted[k]:
                area = part * _area_along(known, owner, frontier, row, col, part * k, reach)
                areas[i] += area
                sums[i, 0] += area * math.cos(part * k)
                sums[i, 1] += area * math.sin(part * k)
    return areas, sums


@kernel
def _aim(row: int, col: int, edge: Cells, reach: float, is_wanted: Mask) -> None:
    """Mark the rays from a cell that meet frontier cells (M, 2) within reach."""
    part = 2.0 * math.pi / _RAYS
    for n in range(edge.shape[0]):
        down = edge[n, 0] - row
        right = edge[n, 1] - col
        away = math.hypot(down, right)
        if away >= reach:
            continue
        angle = math.atan2(down, right)
        half = _HALF_DIAGONAL / max(away, 0.5)
        for k in range(int(math.ceil((angle - half) / part)), int((angle + half) // part) + 1):
            is_wanted[k % _RAYS] = True


@kernel
def _area_along(
    known: tuple[Mask, Mask],
    owner: NDArray[np.int32],
    frontier: int,
    row: int,
    col: int,
    angle: float,
    reach: tuple[float, float],
) -> float:
    """Unknown area per rad that a ray from a cell enters through a frontier; see _areas."""
    free, passable = known
    rows, cols = free.shape
    c, step_x, next_x, delta_x = axis_setup(col + 0.5, math.cos(angle))
    r, step_y, next_y, delta_y = axis_setup(row + 0.5, math.sin(angle))
    travelled = 0.0
    is_through = False  # whether the last free cell is one of the frontier
    entered = -1.0  # distance at which the ray has left the free cells
    area = 0.0
    while travelled <= reach[0]:
        inside = 0 <= r < rows and 0 <= c < cols
        if inside and free[r, c]:
            is_through = owner[r, c] == frontier
            entered = -1.0
        elif inside and not passable[r, c]:
            break
        elif entered < 0.0:
            entered = travelled
        before = travelled
        if next_x < next_y:
            travelled = next_x
            next_x += delta_x
            c += step_x
        else:
            travelled = next_y
            next_y += delta_y
            r += step_y
        if is_through and entered >= 0.0:
            end = min(travelled, reach[0])
            middle = 0.5 * (before + end)
            area += middle * (end - before) * math.exp((entered - middle) / reach[1])
    return area
