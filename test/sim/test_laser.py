"""The laser: exact in a box with known ranges, and with the errors of real lasers."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thinmap_ros.core import se2
from thinmap_ros.core.errors import ConfigError
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.scan import Scan
from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig
from thinmap_ros.sim.world import World

EXACT = LaserScannerConfig(range_noise_m=0.0, mixed_pixel_ratio=0.0, range_resolution_m=0.0)


def box(width_m: float = 6.0, height_m: float = 4.0, pillar: bool = False) -> World:
    """A box whose inner walls are at 0 and width, 0 and height.

    With a pillar of 0.4 m around (4, 2).
    """
    resolution = 0.02
    cells = np.zeros(
        (round((height_m + 0.2) / resolution), round((width_m + 0.2) / resolution)), dtype=np.uint8
    )
    cells[:5] = 1
    cells[-5:] = 1
    cells[:, :5] = 1
    cells[:, -5:] = 1
    if pillar:
        cells[95:115, 195:215] = 1
    return World('box', cells, GridFrame(-0.1, -0.1, resolution), np.array([1.0, 2.0, 0.0]))


BOX = box()


def analytic(
    x: float, y: float, theta: float, angles: np.ndarray, width: float = 6.0
) -> np.ndarray:
    """Range to the walls of the empty box, 4 m high."""
    height = 4.0
    dx = np.cos(angles + theta)
    dy = np.sin(angles + theta)
    with np.errstate(divide='ignore'):
        to_x = np.where(dx > 0, (width - x) / dx, np.where(dx < 0, -x / dx, np.inf))
        to_y = np.where(dy > 0, (height - y) / dy, np.where(dy < 0, -y / dy, np.inf))
    return np.minimum(to_x, to_y)


@settings(deadline=None, max_examples=60)
@given(st.floats(0.3, 5.7), st.floats(0.3, 3.7), st.floats(-3.2, 3.2))
def test_ranges_are_the_geometry(x: float, y: float, theta: float) -> None:
    scan = LaserScanner(EXACT, 0).scan(BOX, np.array([x, y, theta]), 5)
    assert scan.ranges_m.size == 181
    assert scan.stamp_ns == 5
    assert np.allclose(scan.ranges_m, analytic(x, y, theta, scan.angles_rad), atol=2e-6)


def test_the_fan_is_that_of_an_lms200() -> None:
    scan = LaserScanner(LaserScannerConfig(), 0).scan(BOX, BOX.start, 0)
    assert np.allclose(np.degrees(scan.angles_rad), np.arange(-90, 91), atol=1e-4)
    assert (scan.range_min_m, scan.range_max_m) == (pytest.approx(0.05), 8.0)


def test_beyond_the_range_there_is_no_return() -> None:
    world = box(20.0, 4.0)
    scan = LaserScanner(EXACT, 0).scan(world, np.array([1.0, 2.0, 0.0]), 0)
    true = analytic(1.0, 2.0, 0.0, scan.angles_rad, 20.0)
    assert np.array_equal(scan.no_return, true >= 8.0)
    assert scan.no_return.sum() > 10
    assert np.array_equal(scan.hit, true < 8.0)
    assert np.isinf(scan.ranges_m[scan.no_return]).all()


@pytest.mark.parametrize(
    ('beams', 'fov', 'range_m'), [(541, 270.0, 4.0), (360, 360.0, 80.0), (181, 180.0, 8.0)]
)
def test_other_lasers(beams: int, fov: float, range_m: float) -> None:
    config = LaserScannerConfig(
        beams=beams,
        field_of_view_deg=fov,
        range_max_m=range_m,
        range_noise_m=0.0,
        mixed_pixel_ratio=0.0,
        range_resolution_m=0.0,
    )
    scan = LaserScanner(config, 0).scan(BOX, np.array([3.0, 1.0, 1.0]), 0)
    assert scan.ranges_m.size == beams
    step = fov / beams if fov == 360.0 else fov / (beams - 1)
    assert math.degrees(scan.angle_increment_rad) == pytest.approx(step, rel=1e-5)
    assert math.degrees(scan.angle_min_rad) == pytest.approx(-fov / 2, rel=1e-5)
    true = analytic(3.0, 1.0, 1.0, scan.angles_rad)
    near = true < range_m
    assert np.allclose(scan.ranges_m[near], true[near], atol=2e-6)
    assert scan.no_return[~near].all()


def test_the_mount_moves_the_laser() -> None:
    config = LaserScannerConfig(
        laser_x_m=0.4, range_noise_m=0.0, mixed_pixel_ratio=0.0, range_resolution_m=0.0
    )
    T_world_base = np.array([1.0, 2.0, 0.7])
    scan = LaserScanner(config, 0).scan(BOX, T_world_base, 0)
    points = se2.transform_points(T_world_base, scan.points_base())
    on_wall = np.minimum.reduce(
        [abs(points[:, 0]), abs(points[:, 0] - 6), abs(points[:, 1]), abs(points[:, 1] - 4)]
    )
    assert on_wall.max() < 1e-5
    assert np.array_equal(scan.T_base_laser, [0.4, 0.0, 0.0])


def test_noise_has_its_sigma_and_ranges_are_whole_millimetres() -> None:
    laser = LaserScanner(LaserScannerConfig(range_noise_m=0.01, mixed_pixel_ratio=0.0), 3)
    scans = [laser.scan(BOX, np.array([3.0, 2.0, 0.4]), i) for i in range(200)]
    exact = LaserScanner(EXACT, 0).scan(BOX, np.array([3.0, 2.0, 0.4]), 0)
    errors = np.array([s.ranges_m for s in scans]) - exact.ranges_m
    assert abs(errors.mean()) < 3e-4
    assert errors.std() == pytest.approx(0.01, rel=0.03)
    millimetres = 1000.0 * np.array([s.ranges_m for s in scans])
    assert np.abs(millimetres - np.round(millimetres)).max() < 1e-3


def test_mixed_pixels_lie_between_the_two_surfaces_and_only_at_edges() -> None:
    world = box(pillar=True)
    pose = np.array([1.0, 2.0, 0.0])
    exact = LaserScanner(EXACT, 0).scan(world, pose, 0).ranges_m
    mixing = LaserScanner(
        LaserScannerConfig(range_noise_m=0.0, range_resolution_m=0.0, mixed_pixel_ratio=1.0), 1
    )
    changed = np.zeros(exact.size, dtype=bool)
    for i in range(50):
        ranges = mixing.scan(world, pose, i).ranges_m
        moved = np.flatnonzero(ranges != exact)
        changed[moved] = True
        for beam in moved:
            around = exact[beam - 1 : beam + 2]
            assert np.ptp(around) > 0.3
            assert around.min() <= ranges[beam] <= around.max()
    assert changed.sum() == 4, 'the pillar has two edges, with a beam on either side'


def test_mixed_pixels_favour_neither_side() -> None:
    """A pillar straight ahead: its left and right edges are symmetric on average."""
    world = box(pillar=True)
    pose = np.array([1.0, 2.0, 0.0])
    laser = LaserScanner(
        LaserScannerConfig(range_noise_m=0.0, range_resolution_m=0.0, mixed_pixel_ratio=1.0), 1
    )
    mean = np.mean([laser.scan(world, pose, i).ranges_m for i in range(1000)], axis=0)
    off = mean - LaserScanner(EXACT, 0).scan(world, pose, 0).ranges_m
    assert np.abs(off).max() > 0.3
    np.testing.assert_allclose(off, off[::-1], atol=0.1)


def test_mixed_pixels_come_as_often_as_said() -> None:
    world = box(pillar=True)
    laser = LaserScanner(
        LaserScannerConfig(range_noise_m=0.0, range_resolution_m=0.0, mixed_pixel_ratio=0.3), 1
    )
    exact = LaserScanner(EXACT, 0).scan(world, world.start, 0).ranges_m
    mixed = [int((laser.scan(world, world.start, i).ranges_m != exact).sum()) for i in range(500)]
    assert np.mean(mixed) == pytest.approx(0.6, abs=0.1)


def test_the_seed_decides_the_noise() -> None:
    def ranges(seed: int) -> Scan:
        return LaserScanner(LaserScannerConfig(), seed).scan(BOX, BOX.start, 0)

    assert np.array_equal(ranges(1).ranges_m, ranges(1).ranges_m)
    assert not np.array_equal(ranges(1).ranges_m, ranges(2).ranges_m)


def test_nonsense_is_refused() -> None:
    with pytest.raises(ConfigError, match='beams'):
        LaserScannerConfig(beams=1)
    with pytest.raises(ConfigError, match='range_max_m'):
        LaserScannerConfig(range_max_m=float('nan'))
