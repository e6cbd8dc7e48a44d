"""A lost robot that drives where the places in question differ most, to find itself sooner."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import UNKNOWN as UNKNOWN_CELL
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.places.global_localizer import LIKELY, Result
from thinmap_ros.core.places.place_database import (
    Bytes,
    GlobalLocalizationConfig,
    Places,
    free_way,
)
from thinmap_ros.core.places.wall_field import FREE, UNKNOWN, WALL
from thinmap_ros.core.planning.navigator import Command, Navigator, NavigatorConfig
from thinmap_ros.core.planning.wavefront import WavefrontConfig, navigation_function, ways_out
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.thinning import standing_room
from thinmap_ros.jit import kernel

# A goal stands so long, or until it is reached, or, after a quarter of that, the number of places
# in question changes.
_REPLAN_PERIOD_S = 4.0
_MAX_PLACES = 8  # the likeliest, which are compared
_WINDOW_M = 30.0
_SPACING_M = 0.6  # of the viewpoints that are compared
_BEARINGS = 24
# Ranges that differ by more than this, and by this share, tell two places apart; as many as this
# share do so surely.
_DIFFERENT_M = 0.4
_DIFFERENT_SHARE = 0.1
_ENOUGH = 0.25
_MIN_GAIN = 0.05
_CONFIRMED_M = 5.0  # of way, where one place only is left: it has then been seen from enough sides
_NEAREST_M = 0.5  # nearer than this only a turn shows new things
_WAY_M = 2.0  # so much way costs half of what is gained
# Places this near to each other are one that is not known closely: nothing has to tell them apart.
_SAME_M = 1.0
_SAME_RAD = 0.35
# Who has looked from this near, and turned no more than this away, has seen it.
_LOOKED_M = 0.8
_LOOKED_RAD = 0.8


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A place to drive to.

    Pose (3,) in the odometry's frame, map of what all places have in common there, and gain.
    The heading is towards what differs, or onwards. gain: share of the pairs of places that are
    told apart there, by their weights; 0 where one place only is left, or where nothing is known to
    differ.
    """

    T_odom_view: Array
    patch: GridPatch
    gain: float


class ActiveSearch:
    """From what is known of a lost robot to velocities, in the odometry's frame.

    No place in the map is needed.
    The goal is where the views from the places in question differ most for the way; the path leads
    over what the map says is free for all of them, and the navigator stops in front of what the
    laser sees. Where one place only is in question, any way confirms it; where nothing in reach
    tells the places apart, the robot goes on to what it has not looked at yet, and stands only
    where there is no such thing.
    """

    def __init__(
        self, places: Places, config: GlobalLocalizationConfig, driving: NavigatorConfig
    ) -> None:
        self._places = places
        self._range_m = config.compared_range_m
        self._driving = driving
        self._navigator = Navigator(driving)
        self._view: Viewpoint | None = None
        self._starts = np.empty((0, 3))
        self._weights = np.empty(0)
        self._looked = np.empty((0, 3))
        self._chosen_of = 0
        self._age_s = math.inf

    def take(self, result: Result, T_odom_base: Array) -> None:
        """Add the result of a scan at an odometry pose (3,)."""
        self._look(T_odom_base)
        most = max((h.weight for h in result.hypotheses), default=0.0)
        likely = [h for h in result.hypotheses if h.weight >= LIKELY * most]
        T_base_odom = se2.invert(T_odom_base)
        starts = np.array([se2.compose(h.T_map_base, T_base_odom) for h in likely])
        self._starts = starts.reshape(-1, 3)
        self._weights = np.array([h.weight for h in likely])

    def _look(self, T_odom_base: Array) -> None:
        """Remember where the robot has looked from."""
        away = self._looked - T_odom_base
        near = np.hypot(away[:, 0], away[:, 1]) < 0.5 * _LOOKED_M
        if not (near & (np.abs(se2.wrap(away[:, 2])) < 0.5 * _LOOKED_RAD)).any():
            self._looked = np.concatenate([self._looked, T_odom_base[None]])

    def step(self, T_odom_base: Array, scan: Scan | Sequence[Scan], dt_s: float) -> Command:
        """Command for the next dt_s of a robot at an odometry pose (3,); scan: as for `Navigator`.

        Idle where there is nothing to drive to.
        """
        self._age_s += dt_s
        changed = len(self._starts) != self._chosen_of and self._age_s > 0.25 * _REPLAN_PERIOD_S
        if changed or self._age_s > _REPLAN_PERIOD_S:
            self._choose(T_odom_base)
        if self._view is None:
            reason = 'nothing in reach tells the places apart, and all was looked at'
            return Command(0.0, 0.0, 'idle', reason)
        command = self._navigator.step(T_odom_base, self._view.patch, scan, dt_s)
        if command.state in ('reached', 'failed', 'idle'):
            self._age_s = math.inf
        return command

    def _choose(self, T_odom_base: Array) -> None:
        self._age_s = 0.0
        self._chosen_of = len(self._starts)
        self._view = None
        if len(self._starts):
            self._view = best_viewpoint(
                self._places,
                T_odom_base,
                self._starts,
                self._weights,
                self._range_m,
                self._driving.planner,
                self._looked,
            )
        if self._view is None:
            self._navigator.cancel()
        else:
            self._navigator.set_goal(*self._view.T_odom_view.tolist())


def best_viewpoint(
    places: Places,
    T_odom_base: Array,
    starts: Array,
    weights: Array,
    range_m: float,
    driving: WavefrontConfig,
    looked: Array | None = None,
) -> Viewpoint | None:
    """Viewpoint for a robot at an odometry pose (3,).

    starts (H, 3): any of them may be T_map_odom, with weights (H,).
    The path to the viewpoint is free in the map from each of the starts, as the motion is the same
    for all. It may be a turn only. range_m: distance up to which views are compared; looked (M, 3):
    odometry poses of earlier viewpoints, which add no information. If no viewpoint in reach
    distinguishes the places, it is the farthest new one. None: there is no new one.
    """
    looked = np.empty((0, 3)) if looked is None else looked
    starts, weights = _distinct(T_odom_base, starts, weights)
    patch = common_patch(places, T_odom_base, starts)
    at, ways = _in_reach(patch, T_odom_base, driving)
    gains, bearings = _gains(places, starts, weights, at, range_m)
    worth = gains if len(starts) > 1 else np.minimum(ways / _CONFIRMED_M, 1.0)
    worth = np.where(_is_new(at, bearings, looked), worth, 0.0) / (ways + _WAY_M)
    best = int(worth.argmax())
    if worth[best] >= _MIN_GAIN:
        view = se2.pose(at[best, 0], at[best, 1], bearings[best])
        return Viewpoint(view, patch, float(gains[best]))
    onwards = np.arctan2(at[:, 1] - T_odom_base[1], at[:, 0] - T_odom_base[0])
    onwards[ways == 0.0] = T_odom_base[2] + np.pi
    far = np.where(_is_new(at, onwards, looked), ways, -1.0)
    best = int(far.argmax())
    if far[best] < 0.0:
        return None
    return Viewpoint(se2.pose(at[best, 0], at[best, 1], onwards[best]), patch, 0.0)


def _distinct(T_odom_base: Array, starts: Array, weights: Array) -> tuple[Array, Array]:
    """The likeliest of T_map_odom (H, 3), and their weights.

    Of those with the robot at about the same place, one is kept.
    What is as likely, but beside another by little, must neither close its way nor be told apart
    from it.
    """
    order = np.argsort(-weights, kind='stable')
    robots = np.array([se2.compose(T, T_odom_base) for T in starts[order]])
    kept = order[se2.distinct(robots, _SAME_M, _SAME_RAD, _MAX_PLACES)]
    return starts[kept], weights[kept]


def _is_new(at: Array, bearings: Array, looked: Array) -> NDArray[np.bool_]:
    """Which views from points (N, 2) to bearings (N,) are unlike all looked from (M, 3), (N,)."""
    near = np.hypot(*(at[:, None] - looked[None, :, :2]).transpose(2, 0, 1)) < _LOOKED_M
    same = np.abs(se2.wrap(bearings[:, None] - looked[None, :, 2])) < _LOOKED_RAD
    return np.asarray(~(near & same).any(axis=1))


def common_patch(places: Places, T_odom_base: Array, starts: Array) -> GridPatch:
    """What the map says round the robot, in the odometry's frame, for all T_map_odom (H, 3) alike.

    Free is what is free for all, occupied what is so for any of them.
    """
    resolution = places.frame.resolution
    count = 2 * round(_WINDOW_M / 2.0 / resolution) + 1
    corner = T_odom_base[:2] - 0.5 * count * resolution
    frame = GridFrame(float(corner[0]), float(corner[1]), resolution)
    origin = (places.frame.origin_x, places.frame.origin_y)
    states = _common_states(places.states, starts, origin, corner, count, resolution)
    cells = np.select(
        [states == WALL, states == FREE], [np.int8(100), np.int8(0)], np.int8(UNKNOWN_CELL)
    )
    return GridPatch(frame, cells.astype(np.int8))


@kernel
def _common_states(
    states: Bytes,
    starts: Array,
    origin: tuple[float, float],
    corner: Array,
    count: int,
    resolution: float,
) -> Bytes:
    """WALL where any of the transforms (H, 3) leads into a wall of the map.

    Else UNKNOWN where any leads into the unknown, else FREE.
    """
    result = np.full((count, count), FREE, dtype=np.uint8)
    for h in range(len(starts)):
        c = math.cos(starts[h, 2])
        s = math.sin(starts[h, 2])
        for i in range(count):
            for j in range(count):
                x = corner[0] + (j + 0.5) * resolution
                y = corner[1] + (i + 0.5) * resolution
                col = int(math.floor((starts[h, 0] + c * x - s * y - origin[0]) / resolution))
                row = int(math.floor((starts[h, 1] + s * x + c * y - origin[1]) / resolution))
                inside = row >= 0 and col >= 0 and row < states.shape[0] and col < states.shape[1]
                state = states[row, col] if inside else UNKNOWN
                if state == WALL or (state == UNKNOWN and result[i, j] == FREE):
                    result[i, j] = state
    return result


def _in_reach(
    patch: GridPatch, T_odom_base: Array, driving: WavefrontConfig
) -> tuple[Array, Array]:
    """Reachable points (N, 2) a spacing apart, and the path length to each, (N,), m.

    The position of the robot is the first point.
    """
    resolution = patch.frame.resolution
    standing = standing_room(patch.free, driving.robot_radius_m / resolution)
    middle = patch.shape[0] // 2, patch.shape[1] // 2
    cost = np.where(standing, 1.0, np.inf)
    cost[tuple(ways_out(standing, patch.occupied, middle, resolution, driving).T)] = 1.0
    metres = navigation_function(cost, middle) * resolution
    near_by = np.argwhere(standing & (metres >= _NEAREST_M) & np.isfinite(metres))
    step = max(1, round(_SPACING_M / resolution))
    cells = near_by[((near_by - middle) % step == 0).all(axis=1)]
    at = patch.frame.centres_of(cells)
    far = metres[cells[:, 0], cells[:, 1]]
    return np.concatenate([T_odom_base[None, :2], at]), np.concatenate([[0.0], far])


def _gains(
    places: Places, starts: Array, weights: Array, at: Array, range_m: float
) -> tuple[Array, Array]:
    """Share of the pairs of places that points (N, 2) distinguish, and the bearing for it.

    Points and bearings are in the frame of the odometry.
    """
    resolution = places.frame.resolution
    origin = (places.frame.origin_x, places.frame.origin_y)
    views = np.stack([(se2.transform_points(T, at) - origin) / resolution for T in starts])
    headings = starts[:, 2].copy()  # contiguous, whatever their number: one kernel
    ranges = _ranges(places.states, views, headings, range_m / resolution) * resolution
    gains = np.zeros(len(at))
    total = 0.0
    towards = np.zeros(len(at), dtype=np.complex128)
    unit = np.exp(2j * np.pi * np.arange(_BEARINGS) / _BEARINGS)
    for i in range(len(starts)):
        for j in range(i):
            nearer = np.minimum(ranges[i], ranges[j])
            farther = np.maximum(ranges[i], ranges[j])
            # Not where either is unknown.
            differs = farther - nearer > _DIFFERENT_M + _DIFFERENT_SHARE * nearer
            pair = float(weights[i] * weights[j])
            gains += pair * np.minimum(differs.mean(axis=1) / _ENOUGH, 1.0)
            towards += pair * (differs * unit).sum(axis=1)
            total += pair
    return gains / max(total, 1e-300), np.angle(towards)


@kernel
def _ranges(states: Bytes, views: Array, headings: Array, most: float) -> NDArray[np.float64]:
    """Ranges in cells all round from views (H, N, 2), x and y in cells, (H, N, _BEARINGS).

    NaN into the unknown.
    """
    ranges = np.empty((views.shape[0], views.shape[1], _BEARINGS))
    for h in range(views.shape[0]):
        for i in range(views.shape[1]):
            for k in range(_BEARINGS):
                angle = headings[h] + 2.0 * math.pi * k / _BEARINGS
                way, state = free_way(states, views[h, i, 0], views[h, i, 1], angle, most)
                ranges[h, i, k] = np.nan if state == UNKNOWN else way
    return ranges
