"""A small room of line segments, and a robot that drives through it."""

import math
from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.slam.matching.local_map import LocalMap, LocalMapConfig
from thinmap_ros.core.slam.matching.surface import COLUMNS, surface_points

RANGE_MAX_M = 8.0

# 10 x 10 m with an inner wall, a box and a doorway: [x0, y0, x1, y1].
ROOM = np.array(
    [
        [0.0, 0.0, 10.0, 0.0],
        [10.0, 0.0, 10.0, 10.0],
        [10.0, 10.0, 0.0, 10.0],
        [0.0, 10.0, 0.0, 0.0],
        [0.0, 5.0, 3.5, 5.0],
        [4.7, 5.0, 6.0, 5.0],
        [7.0, 2.0, 8.0, 2.0],
        [8.0, 2.0, 8.0, 3.0],
        [8.0, 3.0, 7.0, 3.0],
        [7.0, 3.0, 7.0, 2.0],
    ]
)


def ranges_in(segments: np.ndarray, T_world_laser: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Exact range of each ray to the nearest segment; inf without one."""
    directions = np.column_stack(
        [np.cos(angles + T_world_laser[2]), np.sin(angles + T_world_laser[2])]
    )
    starts = segments[:, :2] - T_world_laser[:2]
    along = segments[:, 2:] - segments[:, :2]
    cross = directions[:, None, 0] * along[None, :, 1] - directions[:, None, 1] * along[None, :, 0]
    with np.errstate(divide='ignore', invalid='ignore'):
        t = (starts[:, 0] * along[:, 1] - starts[:, 1] * along[:, 0])[None] / cross
        u = (
            starts[None, :, 0] * directions[:, None, 1]
            - starts[None, :, 1] * directions[:, None, 0]
        ) / cross
    met = (np.abs(cross) > 1e-12) & (t > 0.0) & (u >= 0.0) & (u <= 1.0)
    return np.where(met, t, np.inf).min(axis=1)


def scan_in(
    segments: np.ndarray,
    T_world_base: np.ndarray,
    rng: np.random.Generator | None = None,
    stamp_ns: int = 0,
    T_base_laser: np.ndarray | None = None,
    beams: int = 181,
    clockwise: bool = False,
) -> Scan:
    """A 180 degree scan; with rng: 1 cm of noise, and mixed pixels at a third of range jumps."""
    mount = np.zeros(3) if T_base_laser is None else T_base_laser
    sign = -1.0 if clockwise else 1.0
    start = -sign * math.pi / 2.0
    step = sign * math.pi / (beams - 1)
    ranges = ranges_in(segments, se2.compose(T_world_base, mount), start + step * np.arange(beams))
    if rng is not None:
        ranges = mixed(ranges, rng) + rng.normal(0.0, 0.01, beams)
    ranges = np.where(ranges < RANGE_MAX_M, ranges, np.inf)
    return Scan.create(stamp_ns, ranges, start, step, 0.05, RANGE_MAX_M, mount)


def seen_in(
    segments: np.ndarray, T_world_base: np.ndarray, rng: np.random.Generator | None = None
) -> np.ndarray:
    """Surface points (N, 5) of a scan, robot frame."""
    return surface_points(scan_in(segments, T_world_base, rng))


def on_wall(points: np.ndarray, angle_rad: float = math.pi / 2.0, share: float = 1.0) -> np.ndarray:
    """Surface points (N, 5) at points (N, 2) of a wall whose normal is at an angle.

    share: certainty of the normal, 0 to 1. Their spacing gives each of them full weight.
    """
    surface = np.ones((len(points), COLUMNS))
    surface[:, :2] = points
    surface[:, 2] = share * math.cos(2.0 * angle_rad)
    surface[:, 3] = share * math.sin(2.0 * angle_rad)
    return surface


def map_of(
    segments: np.ndarray,
    poses: Iterable[np.ndarray],
    rng: np.random.Generator | None = None,
    config: LocalMapConfig | None = None,
) -> LocalMap:
    """The local map of scans at some poses (3,)."""
    local_map = LocalMap(config)
    for pose in poses:
        local_map.add_scan(seen_in(segments, pose, rng), np.zeros(3), pose)
    return local_map


def around(pose: np.ndarray, number: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Poses (3,) near a pose: within some 20 cm and 11 degrees."""
    return [pose + rng.normal(0.0, [0.2, 0.2, 0.2]) for _ in range(number)]


def mixed(ranges: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    low = np.minimum(ranges[:-1], ranges[1:])
    high = np.maximum(ranges[:-1], ranges[1:])
    with np.errstate(invalid='ignore'):
        edge = np.isfinite(high) & (high - low > 0.3) & (rng.random(low.size) < 0.3)
        between = low + rng.random(low.size) * (high - low)
    result = ranges.copy()
    result[:-1] = np.where(edge, between, result[:-1])
    return result


def drive(
    steps: int,
    rng: np.random.Generator,
    start: np.ndarray,
    scale: float = 1.03,
    drift_rad_m: float = 0.05,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """True pose (3,) and drifting odometry (3,) of a drive round the room at 0.2 m/s and 5 Hz."""
    way = np.array(
        [
            [2.0, 2.0],
            [5.5, 1.5],
            [5.5, 4.0],
            [4.1, 5.0],
            [4.1, 7.0],
            [2.0, 8.0],
            [7.0, 8.0],
            [8.5, 5.0],
        ]
    )
    truth = start
    odom = np.zeros(3)
    goal = 1
    for _ in range(steps):
        yield truth, odom
        off = way[goal % len(way)] - truth[:2]
        if np.hypot(*off) < 0.2:
            goal += 1
        turn = np.clip(se2.wrap(math.atan2(off[1], off[0]) - truth[2]), -0.12, 0.12)
        ahead = 0.04 if abs(turn) < 0.1 else 0.0
        truth = se2.compose(truth, np.array([ahead, 0.0, turn]))
        rolled = scale * ahead + rng.normal(0.0, 0.001)
        turned = 0.97 * turn + drift_rad_m * ahead + rng.normal(0.0, 0.002)
        odom = se2.compose(odom, np.array([rolled, 0.0, turned]))


BLIND = scan_in(np.array([[1e3, -1.0, 1e3, 1.0]]), np.zeros(3))  # a scan without hits


def corridor_ring() -> np.ndarray:
    """Walls (N, 4) of a corridor of 2.4 m round a block of 35 x 15 m; its sides have niches."""
    outer = np.array([40.0, 20.0])
    inner = 2.4
    corners = [np.array([[0.0, 0.0], [outer[0], 0.0], outer, [0.0, outer[1]], [0.0, 0.0]])]
    low = np.array([inner, inner])
    high = outer - inner
    corners.append(np.array([low, [high[0], low[1]], high, [low[0], high[1]], low]))
    walls = [np.hstack([a, b]) for ring_ in corners for a, b in pairwise(ring_)]
    for x in (6.0, 13.0, 17.5, 26.0, 33.0):
        walls += [
            np.array([x, 0.0, x, 0.4]),
            np.array([x, 0.4, x + 0.5, 0.4]),
            np.array([x + 0.5, 0.4, x + 0.5, 0.0]),
        ]
        walls += [
            np.array([x + 1.0, 20.0, x + 1.0, 19.6]),
            np.array([x + 1.0, 19.6, x + 2.0, 19.6]),
        ]
    return np.array(walls)


def corridor(length_m: float) -> np.ndarray:
    """Walls (N, 4) of a corridor of 2.4 m along x from the origin, with niches and open ends."""
    walls = []
    for side in (-1.2, 1.2):
        line = [(0.0, side)]
        for x in np.arange(2.0 + 0.5 * side, length_m - 2.0, 4.0):
            line += [(x, side), (x, 1.3 * side), (x + 0.9, 1.3 * side), (x + 0.9, side)]
        line.append((length_m, side))
        walls += [[*a, *b] for a, b in pairwise(line)]
    return np.array(walls)


def drive_round_the_block() -> Iterator[tuple[Scan, np.ndarray, np.ndarray]]:
    """Scan, odometry and true pose of over a lap of the corridor, with worn and slipping wheels."""
    rng = np.random.default_rng(5)
    slips = np.random.default_rng(6)
    walls = corridor_ring()
    truth = np.array([3.0, 1.2, 0.0])
    odom = np.zeros(3)
    number = 0
    for goal in [(38.8, 1.2), (38.8, 18.8), (1.2, 18.8), (1.2, 1.2), (20.0, 1.2)]:
        while np.hypot(*(goal - truth[:2])) > 0.15:
            turn = float(
                np.clip(se2.wrap(np.arctan2(*(goal - truth[:2])[::-1]) - truth[2]), -0.3, 0.3)
            )
            step = np.array([0.15 if abs(turn) < 0.1 else 0.0, 0.0, turn])
            truth = se2.compose(truth, step)
            slip = slips.normal(0.0, 0.08)
            worn = 1.0 + 0.12 * min(number / 400.0, 1.0)
            odom = se2.compose(odom, step * [worn, 1.0, 1.02] + [0.0, 0.0, 0.01 * step[0] + slip])
            yield scan_in(walls, truth, rng, 200_000_000 * number), odom, truth
            number += 1
