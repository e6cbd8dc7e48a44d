"""True and estimated poses of the robot over time, and what was drawn into its map meanwhile."""

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinmap_ros.core import se2
from thinmap_ros.core.grid.fields import distance_cells
from thinmap_ros.core.grid.patch import UNKNOWN, GridPatch
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.sim.world import World

_SPAN_NS = 60 * SECOND_NS
_SPEED_NS = SECOND_NS // 2


@dataclass(frozen=True)
class Located:
    """A scan that has a pose: time, s; error of the pose, m; whether the state is TRACKING.

    stamp_ns: its stamp, which may be wrong.
    """

    time_s: float
    error_m: float
    is_tracking: bool
    stamp_ns: int


class _Recent(dict[int, Array]):
    """Poses (3,) by stamp, of the last minute."""

    def put(self, stamp_ns: int, pose: Array) -> None:
        self.pop(stamp_ns, None)
        self[stamp_ns] = pose
        while stamp_ns - next(iter(self)) > _SPAN_NS:
            del self[next(iter(self))]


class Track:
    """Compares estimated with true poses, and measures the distance travelled.

    The stamps of scans may be wrong: `add_scan` tells the true time of each.
    T_world_map (3,): where the map lies in the world.
    """

    def __init__(self) -> None:
        self.T_world_map: Array = np.zeros(3)
        self.travelled_m = 0.0
        self.time_ns = 0
        self._truth = _Recent()
        self._true_ns: dict[int, int] = {}
        self._poses: dict[int, Array] = {}
        self._states: dict[int, bool] = {}
        self._waiting: deque[int] = deque(maxlen=1000)

    @property
    def time_s(self) -> float:
        """Simulated time, s."""
        return self.time_ns / SECOND_NS

    @property
    def place(self) -> Array | None:
        """True pose (3,) now; None before the first."""
        return next(reversed(self._truth.values()), None)

    def speed_m_s(self) -> float:
        """Mean speed over the last half second, m/s."""
        before_ns = self.time_ns - _SPEED_NS
        if before_ns not in self._truth:
            return 0.0
        moved = self._truth[self.time_ns][:2] - self._truth[before_ns][:2]
        return float(np.hypot(*moved)) * SECOND_NS / _SPEED_NS

    def add_truth(self, stamp_ns: int, T_world_base: Array) -> None:
        """Add a true pose (3,)."""
        if self.place is not None:
            self.travelled_m += math.dist(self.place[:2], T_world_base[:2])
        self.time_ns = stamp_ns
        self._truth.put(stamp_ns, T_world_base)

    def teleported(self) -> None:
        """The way to the next true pose is not driven."""
        self._truth.clear()

    def add_scan(self, stamp_ns: int, true_ns: int) -> None:
        """Add a scan that was passed on with a stamp, and its true time."""
        self._true_ns.pop(stamp_ns, None)
        self._true_ns[stamp_ns] = true_ns
        while len(self._true_ns) > 1000:
            del self._true_ns[next(iter(self._true_ns))]

    def add_pose(self, stamp_ns: int, T_map_base: Array) -> None:
        """Add the pose (3,) that was found for a scan."""
        self._poses[stamp_ns] = T_map_base
        self._waiting.append(stamp_ns)

    def add_state(self, stamp_ns: int, is_tracking: bool) -> None:
        """Add the state of the localizer at a scan."""
        self._states[stamp_ns] = is_tracking

    def located(self) -> list[Located]:
        """Scans whose pose, state and true pose are complete since the last call."""
        found = []
        for _ in range(len(self._waiting)):
            stamp_ns = self._waiting.popleft()
            true_ns = self._true_ns.get(stamp_ns)
            known = true_ns in self._truth and stamp_ns in self._states
            if true_ns is None or not known:
                if true_ns is None or true_ns > self.time_ns - _SPAN_NS // 10:
                    self._waiting.append(stamp_ns)
                continue
            pose = self._poses.pop(stamp_ns, None)
            if pose is None:
                continue
            believed = se2.compose(self.T_world_map, pose)
            error_m = math.dist(believed[:2], self._truth[true_ns][:2])
            is_tracking = self._states.pop(stamp_ns)
            found.append(Located(true_ns / SECOND_NS, error_m, is_tracking, stamp_ns))
        return found

    def align(self, T_map_base: Array, stamp_ns: int) -> None:
        """Let the map lie where a pose (3,) at a stamp is the true one."""
        truth = self._truth.get(self._true_ns.get(stamp_ns, -1))
        if truth is not None:
            self.T_world_map = se2.compose(truth, se2.invert(T_map_base))


WRONG_POSE_M = 0.5
WRONG_WALL_M = 0.3
# Cells that touch. A beam that meets two surfaces marks a cell between them: in room_10x10 up to
# nine at a time, each by itself. A wall at a wrong place marks a row.
_MIN_WALL_CELLS = 3


class Walls:
    """Distances from the walls of a world."""

    def __init__(self, world: World) -> None:
        resolution = world.frame.resolution
        # Around the world, too, its walls are near.
        self._border = int(np.ceil(WRONG_WALL_M / resolution)) + 1
        occupied = np.pad(world.occupied != 0, self._border)
        self._distance_m = (distance_cells(occupied) - 0.5) * resolution
        self._frame = world.frame.with_origin_at(-self._border, -self._border)

    def are_wrong(self, points: Array) -> NDArray[np.bool_]:
        """Whether each of the points (N, 2), m, is far from every wall, (N,)."""
        cells = self._frame.cells_of(points)
        is_inside = np.all((cells >= 0) & (cells < self._distance_m.shape), axis=1)
        wrong: NDArray[np.bool_] = ~is_inside
        row, col = cells[is_inside].T
        wrong[is_inside] = self._distance_m[row, col] > WRONG_WALL_M
        return wrong


@dataclass
class Drawn:
    """What was drawn into the map during a record.

    wrong_before, wrong: cells of walls of the map far from every wall of the world, at the
    beginning and now; while_wrong: of these, drawn while the pose was wrong; while_lost: cells
    drawn while the localizer said that it is lost, or that its map is apart from the robot.
    """

    wrong_before: int = 0
    wrong: int = 0
    while_wrong: int = 0
    while_lost: int = 0

    def violations(self) -> list[str]:
        """What must not happen, in words."""
        found = []
        if self.while_lost:
            found.append(f'{self.while_lost} cells drawn into the map while lost')
        if self.while_wrong:
            found.append(
                f'{self.while_wrong} wrong cells drawn while the pose was more than '
                f'{WRONG_POSE_M} m wrong'
            )
        if self.wrong > self.wrong_before:
            found.append(
                f'{self.wrong} cells of walls in the map farther than {WRONG_WALL_M} m from any '
                f'of the world, {self.wrong_before} before'
            )
        return found


@dataclass
class _RecentStates:
    """By stamp of the scan: errors of the pose, m, and whether nothing may be drawn."""

    error_m: dict[int, float] = field(default_factory=dict)
    is_lost: dict[int, bool] = field(default_factory=dict)

    def between(self, begin_ns: int, end_ns: int) -> tuple[list[float], list[bool]]:
        """Values of the scans after one stamp, up to another."""
        errors = [e for ns, e in self.error_m.items() if begin_ns < ns <= end_ns]
        return errors, [lost for ns, lost in self.is_lost.items() if begin_ns < ns <= end_ns]

    def forget_until(self, stamp_ns: int) -> None:
        """Forget the scans up to a stamp."""
        self.error_m = {ns: e for ns, e in self.error_m.items() if ns > stamp_ns}
        self.is_lost = {ns: lost for ns, lost in self.is_lost.items() if ns > stamp_ns}


class MapWatch:
    """Judges each map by the poses of the scans between it and the previous map.

    A map is judged when the next one arrives: by then, poses and states of its scans are known.
    Scans before and after a change of pose or state may be in one map, which is not judged.
    """

    def __init__(self, world: World, track: Track) -> None:
        """track: knows where the map lies in the world."""
        self._track = track
        self._walls = Walls(world)
        self._drawn = Drawn()
        self._recent = _RecentStates()
        self._maps: list[tuple[int, GridPatch]] = []

    def begin(self) -> Drawn:
        """Begin a record, which is kept up to date until the next one begins."""
        wrong = self._count_wrong()
        self._drawn = Drawn(wrong, wrong)
        return self._drawn

    def discard(self) -> None:
        """The map was reset, or lies elsewhere: nothing is compared with it."""
        self._maps = []
        self._recent = _RecentStates()

    def restart(self) -> None:
        """What was drawn so far does not count: begin the present record again."""
        wrong = self._count_wrong()
        self._drawn.wrong = wrong
        self._drawn.while_wrong = 0
        self._drawn.while_lost = 0

    def add_state(self, stamp_ns: int, is_lost: bool) -> None:
        """Add whether the status of a scan says that nothing may be drawn."""
        self._recent.is_lost[stamp_ns] = is_lost

    def add_error(self, stamp_ns: int, error_m: float) -> None:
        """Add the error of the pose of a scan, m."""
        self._recent.error_m[stamp_ns] = error_m

    def add_map(self, stamp_ns: int, patch: GridPatch) -> None:
        """Add a map with the stamp of its last scan."""
        if self._maps and stamp_ns < self._maps[-1][0]:
            self.discard()
        self._maps.append((stamp_ns, patch))
        self._drawn.wrong = self._count_wrong()
        if len(self._maps) > 2:
            self._judge(*self._maps[:2])
            self._recent.forget_until(self._maps[1][0])
            del self._maps[0]

    def _judge(self, before: tuple[int, GridPatch], after: tuple[int, GridPatch]) -> None:
        errors, lost = self._recent.between(before[0], after[0])
        drawn = are_drawn(before[1], after[1])
        if lost and all(lost):
            self._drawn.while_lost += int(drawn.sum())
        if errors and min(errors) > WRONG_POSE_M:
            self._drawn.while_wrong += self._count(after[1], drawn & are_walls(after[1]))

    def _count_wrong(self) -> int:
        patch = self._maps[-1][1] if self._maps else None
        return 0 if patch is None else self._count(patch, are_walls(patch))

    def _count(self, patch: GridPatch, cells: NDArray[np.bool_]) -> int:
        """Number of the given cells (H, W) of a map that are far from every wall."""
        points = patch.frame.centres_of(np.argwhere(cells))
        in_world = se2.transform_points(self._track.T_world_map, points)
        return int(self._walls.are_wrong(in_world).sum())


def are_walls(patch: GridPatch) -> NDArray[np.bool_]:
    """Which cells of a map (H, W) are occupied together with others that they touch."""
    parts, _ = ndimage.label(patch.occupied, structure=np.ones((3, 3)))
    is_large = np.bincount(parts.ravel()) >= _MIN_WALL_CELLS
    is_large[0] = False
    walls: NDArray[np.bool_] = is_large[parts]
    return walls


def are_drawn(before: GridPatch, after: GridPatch) -> NDArray[np.bool_]:
    """Which cells of a map (H, W) are known and were different, or unknown, before."""
    cells = np.argwhere(~after.unknown)
    points = after.frame.centres_of(cells)
    old = np.full(len(cells), UNKNOWN, dtype=np.int8)
    is_inside = before.contains(points)
    row, col = before.frame.cells_of(points)[is_inside].T
    old[is_inside] = before.trinary()[row, col]
    drawn = np.zeros(after.shape, dtype=bool)
    drawn[tuple(cells.T)] = old != after.trinary()[tuple(cells.T)]
    return drawn
