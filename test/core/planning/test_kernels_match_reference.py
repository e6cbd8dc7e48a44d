"""The kernels of planning and exploration are equal to reference implementations."""

import math

import numpy as np
import pytest
from scipy import ndimage

from thinmap_ros.core import se2
from thinmap_ros.core.exploration.space import _clusters, field_of_view, visible_places
from thinmap_ros.core.grid.fields import reachable
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.planning.grid_search import path_collides
from thinmap_ros.core.planning.obstacles import _arc, _clear_steps, _points_around
from thinmap_ros.core.planning.path_follower import _point_ahead, length_from, nearest_point
from thinmap_ros.core.planning.wavefront import WavefrontConfig, cost_of_cells
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.topology.segmentation import any_in_squares

SEEDS = range(20)


def wandering(rng, count=40):
    return np.cumsum(rng.normal(0.03, 0.05, (count, 2)), axis=0)


def plain_point_ahead(path, xy, reach_m, max_corner_cut_m):
    nearest = int(np.square(path - xy).sum(axis=1).argmin())
    rest = path[nearest:]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(rest, axis=0).T))])
    left_m = max(float(along[-1]), float(np.hypot(*(rest[-1] - xy))))
    last = min(int(np.searchsorted(along, reach_m)), len(rest) - 1)
    allowed = max_corner_cut_m + float(np.hypot(*(rest[0] - xy)))
    while last > 1:
        dx, dy = rest[last] - xy
        off = np.abs((rest[:last, 0] - xy[0]) * dy - (rest[:last, 1] - xy[1]) * dx).max()
        if off / max(math.hypot(dx, dy), 1e-9) <= allowed:
            break
        last -= 1
    return *rest[last], left_m


@pytest.mark.parametrize('seed', SEEDS)
def test_the_point_to_steer_for(seed):
    rng = np.random.default_rng(seed)
    path = wandering(rng)
    xy = rng.normal(0.0, 0.4, 2)
    nearest = nearest_point(path, *xy)
    assert nearest == int(np.square(path - xy).sum(axis=1).argmin())
    assert length_from(path, nearest) == pytest.approx(
        np.hypot(*np.diff(path[nearest:], axis=0).T).sum()
    )
    found = _point_ahead(path, *xy, 0.4, 0.05)
    assert found == pytest.approx(plain_point_ahead(path, xy, 0.4, 0.05))


@pytest.mark.parametrize('seed', SEEDS)
def test_how_far_a_disc_can_be_moved(seed):
    rng = np.random.default_rng(seed)
    centres = wandering(rng)
    points = rng.uniform(-1.0, 2.5, (12, 2))
    distances = np.hypot(*(centres[:, None] - points[None]).transpose(2, 0, 1))
    blocked = (distances < np.minimum(0.24, distances[0])).any(axis=1)
    expected = max(int(blocked.argmax()) - 1, 0) if blocked.any() else len(centres) - 1
    assert _clear_steps(centres, points, 0.24) == expected


@pytest.mark.parametrize('seed', SEEDS)
def test_whether_something_has_come_near_a_path(seed):
    rng = np.random.default_rng(seed)
    cells = np.where(rng.random((50, 50)) < 0.01, 100, 0).astype(np.int8)
    path = np.clip(np.cumsum(rng.integers(-1, 2, (30, 2)), axis=0) + 25, 0, 49)
    away = ndimage.distance_transform_edt(cells < 65)[path[:, 0], path[:, 1]].min()
    patch = GridPatch(GridFrame(-1.0, 2.0, 0.1), cells)
    assert path_collides(patch, patch.frame.centres_of(path), 0.25) == (away < 2.5)


def plain_smoothed(ranges):
    """Mean of each valid range with those up to two beams away that differ by less than 3 cm."""
    beside = [ranges[max(i - 2, 0) : i + 3] for i in range(len(ranges))]
    return np.array(
        [
            near[np.abs(near - r) < 0.03].mean()
            for r, near in zip(ranges, beside, strict=True)
            if r == r
        ]
    )


@pytest.mark.parametrize('seed', SEEDS)
def test_points_around_are_those_of_the_scan_and_earlier_ones_near_and_out_of_view(seed):
    rng = np.random.default_rng(seed)
    ranges = np.repeat(rng.uniform(0.0, 9.0, 25), 4) + rng.normal(0.0, 0.015, 100)
    scan = Scan.create(0, ranges, -1.2, 0.02, 0.05, 8.0, se2.pose(0.2, -0.1, 0.3))
    robot = se2.pose(*rng.normal(size=3))
    earlier = rng.normal(0.0, 1.0, (50, 2))
    laser = se2.compose(robot, scan.T_base_laser)
    bearings = np.arctan2(*(earlier - laser[:2]).T[::-1]) - laser[2]
    middle = 0.5 * (scan.angles_rad[0] + scan.angles_rad[-1])
    in_view = np.abs(se2.wrap(bearings - middle)) <= 0.5 * 99 * 0.02
    kept = earlier[(np.hypot(*(earlier - robot[:2]).T) < 1.0) & ~in_view]
    hits = np.where(scan.hit, scan.ranges_m, np.nan)
    angles = scan.angles_rad[scan.hit]
    smoothed = plain_smoothed(hits)
    seen = se2.transform_points(
        laser, np.column_stack([smoothed * np.cos(angles), smoothed * np.sin(angles)])
    )
    expected = np.concatenate([seen, kept])
    found = _points_around(
        hits, scan.angle_min_rad, scan.angle_increment_rad, laser, earlier, robot
    )
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_hair_by_hair_a_disc_that_is_too_near_comes_no_nearer():
    wall = np.column_stack([np.full(100, 0.23), np.linspace(-1.0, 1.0, 100)])
    x = 0.0
    for _ in range(100):
        x += 0.004 * _clear_steps(np.array([[x, 0.0], [x + 0.004, 0.0]]), wall, 0.24)
    assert x == 0.0


@pytest.mark.parametrize('seed', SEEDS)
def test_places_in_sight(seed):
    rng = np.random.default_rng(seed)
    frame = GridFrame(-1.0, 2.0, 0.1)
    free = rng.random((60, 70)) < 0.97
    places = frame.centres_of(rng.integers(0, 60, (40, 2)))
    laser = np.append(frame.centres_of(np.array([[30, 30]])), 2.5)
    scan = Scan.create(0, np.full(23, 1.0), -0.75, 0.1, 0.05, 2.5)
    low, high = field_of_view(scan)
    assert (low, high) == pytest.approx((-0.85, 1.55))
    bearings = np.arctan2(*(places - laser[:2]).T[::-1]) - laser[2]
    is_ahead = np.abs(se2.wrap(bearings - 0.5 * (low + high))) <= 0.5 * (high - low)
    asked = (np.hypot(*(places - laser[:2]).T) < 2.5) & is_ahead
    clear = [line_is_clear(free, 30, 30, int(row), int(col)) for row, col in frame.cells_of(places)]
    found = visible_places(places, scan, laser, free, frame)
    assert (found == (asked & clear)).all()


@pytest.mark.parametrize('seed', SEEDS)
def test_the_cost_of_cells_falls_with_the_distance_to_what_is_not_free(seed):
    rng = np.random.default_rng(seed)
    config = WavefrontConfig()
    free = ndimage.binary_opening(rng.random((40, 50)) < 0.97)
    cost = cost_of_cells(
        GridPatch(GridFrame(0.0, 0.0, 0.1), np.where(free, 0, 100).astype(np.int8)), config
    )
    away_m = 0.1 * ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1]
    nearness = np.clip(
        (config.inflation_radius_m - away_m) / (config.inflation_radius_m - config.robot_radius_m),
        0.0,
        1.0,
    )
    expected = np.where(
        away_m >= config.robot_radius_m - 1e-6, 1.0 + config.inflation_cost * nearness**2, np.inf
    )
    assert cost == pytest.approx(expected)


@pytest.mark.parametrize('seed', SEEDS)
def test_what_is_joined(seed):
    mask = np.random.default_rng(seed).random((30, 40)) < 0.35
    cells = np.argwhere(mask)
    numbers, sizes = _clusters(cells)
    expected, count = ndimage.label(mask, np.ones((3, 3)))
    assert len(sizes) == count
    assert (numbers + 1 == expected[mask]).all()
    assert (sizes == np.bincount(numbers)).all()
    room = ~mask
    parts, _ = ndimage.label(room, np.ones((3, 3)))
    start = np.argwhere(room)[:1]
    assert (reachable(room, start) == (parts == parts[tuple(start[0])])).all()
    assert not reachable(room, cells[:1]).any()


@pytest.mark.parametrize('seed', SEEDS)
def test_squares_of_cells(seed):
    rng = np.random.default_rng(seed)
    cells = rng.random((31, 44)) < 0.1
    factor = int(rng.integers(1, 5))
    padded = np.pad(cells, [(0, -size % factor) for size in cells.shape])
    shape = (padded.shape[0] // factor, factor, padded.shape[1] // factor, factor)
    expected = padded.reshape(shape).any(axis=(1, 3))
    assert (any_in_squares(cells, factor) == expected).all()


@pytest.mark.parametrize('seed', SEEDS)
def test_an_arc(seed):
    start = np.random.default_rng(seed).normal(size=(3, 3))[0]
    curvature = 0.7 * seed - 5.0
    length = 1.3
    pose = start
    count = 2600
    for _ in range(count):
        pose = se2.compose(pose, se2.pose(length / count, 0.0, curvature * length / count))
    points = _arc(start, curvature, length, 13)
    assert points[0] == pytest.approx(start[:2])
    assert points[-1] == pytest.approx(pose[:2], abs=2e-3)
    steps = np.hypot(*np.diff(points, axis=0).T)
    assert steps == pytest.approx(np.full(13, steps[0]))
