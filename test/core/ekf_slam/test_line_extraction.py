"""Line extraction: accuracy, covariance, and no false lines."""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares
from support.slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam import features
from thinmap_ros.core.ekf_slam.features import LineConfig, extract_lines
from thinmap_ros.core.scan import Scan

BOX = np.array([[-2, -3, 4, -3], [4, -3, 4, 2], [4, 2, -2, 2], [-2, 2, -2, -3]], dtype=float)


def scan_of(ranges, start=-math.pi / 2, step=math.pi / 180):
    return Scan.create(0, ranges, start, step, 0.05, 30.0)


def test_a_box_has_three_walls_in_front():
    lines = extract_lines(scan_in(BOX, np.zeros(3)), LineConfig())
    np.testing.assert_allclose(lines.z, [[3, -math.pi / 2], [4, 0], [2, math.pi / 2]], atol=2e-3)
    np.testing.assert_allclose(lines.ends[1], [[4, -3], [4, 2]], atol=0.1)
    assert (lines.z[:, 0] >= 0.0).all()


def test_a_mounted_laser_and_a_clockwise_one_see_the_same_walls():
    plain = extract_lines(scan_in(BOX, np.zeros(3)), LineConfig())
    mount = np.array([0.4, -0.1, 0.0])
    ahead = extract_lines(scan_in(BOX, np.zeros(3), T_base_laser=mount), LineConfig())
    clockwise = extract_lines(scan_in(BOX, np.zeros(3), clockwise=True), LineConfig())
    np.testing.assert_allclose(ahead.z, plain.z, atol=5e-3)
    np.testing.assert_allclose(clockwise.z[::-1], plain.z, atol=5e-3)


def test_the_fit_is_the_minimum_that_a_general_solver_finds(rng):
    config = LineConfig()
    scan = scan_in(BOX[1:2], np.zeros(3), rng)
    lines = extract_lines(scan, config)
    rho = scan.ranges_m[scan.hit]
    phi = scan.angles_rad[scan.hit]

    def residuals(x):
        d = rho * np.cos(phi - x[1]) - x[0]
        off = phi - lines.z[0, 1]
        along = config.bearing_noise_rad * rho * np.sin(off)
        return d / np.sqrt((config.laser_range_noise_m * np.cos(off)) ** 2 + along**2 + 1e-8)

    best = least_squares(residuals, [3.9, 0.05], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(lines.z[0], best.x, atol=1e-5)
    np.testing.assert_allclose(
        lines.covariances[0], np.linalg.inv(best.jac.T @ best.jac), rtol=1e-3
    )


@pytest.mark.parametrize('mount', [np.zeros(3), np.array([0.5, 0.2, 0.3])])
def test_the_covariance_is_what_many_scans_show(rng, mount):
    config = LineConfig(laser_range_noise_m=0.02, bearing_noise_rad=0.002)
    pose = np.array([0.3, -0.4, 0.2])
    exact = scan_in(BOX[1:2], pose, T_base_laser=mount)
    hit = exact.hit
    normal = se2.compose(pose, mount)[2]
    found = []
    claimed = []
    for _ in range(400):
        # Bearing noise changes the range on this wall: rho = d / cos(phi - alpha).
        off = exact.angles_rad[hit] + normal
        measured = (
            exact.ranges_m[hit] * np.cos(off) / np.cos(off + rng.normal(0.0, 0.002, off.size))
        )
        ranges = exact.ranges_m.copy()
        ranges[hit] = measured + rng.normal(0.0, 0.02, off.size)
        scan = Scan.create(
            0, ranges, exact.angle_min_rad, exact.angle_increment_rad, 0.05, 30.0, mount
        )
        lines = extract_lines(scan, config)
        assert len(lines) == 1
        found.append(lines.z[0])
        claimed.append(lines.covariances[0])
    shown = np.cov(np.array(found).T)
    said = np.mean(claimed, axis=0)
    np.testing.assert_allclose(np.diag(shown), np.diag(said), rtol=0.25)
    correlations = [C[0, 1] / math.sqrt(C[0, 0] * C[1, 1]) for C in (shown, said)]
    assert correlations[0] == pytest.approx(correlations[1], abs=0.15)


def test_trimming_ends_where_too_few_points_are_left():
    """Points far from any common line: each iteration trims an end point."""
    count = 12
    x = np.linspace(-1.0, 1.0, count)
    y = 2.0 + np.where(np.arange(count) % 2, 0.5, -0.5)
    sigmas = np.array([0.01, 0.001, 0.05])
    arguments = (x, y, np.hypot(x, y), np.arctan2(y, x))
    for fewest in (3, 6):
        a, b = features._fit_trimmed(*arguments, 0, count, sigmas, fewest, np.empty(10))
        assert 0 < a <= count - fewest + 1
        assert b - a == fewest - 1


def test_no_lines_on_round_columns_or_in_clutter(rng):
    for radius in (0.15, 0.3, 0.6, 1.0, 2.0):
        ring = np.linspace(0.0, 2.0 * math.pi, 200)
        corners = np.column_stack([radius + 1.5 + radius * np.cos(ring), radius * np.sin(ring)])
        column = np.hstack([corners[:-1], corners[1:]])
        assert len(extract_lines(scan_in(column, np.zeros(3), rng), LineConfig())) == 0, radius
    for _ in range(100):
        assert len(extract_lines(scan_of(rng.uniform(1.0, 6.0, 181)), LineConfig())) == 0
        leaves = 3.0 + np.cumsum(rng.normal(0.0, 0.08, 181))
        assert len(extract_lines(scan_of(leaves), LineConfig(min_points=12))) <= 1


def test_all_lines_of_a_furnished_room_are_walls(rng):
    count = 0
    for _ in range(60):
        pose = np.array([rng.uniform(0.5, 6.5), rng.uniform(0.5, 4.5), rng.uniform(-3.1, 3.1)])
        lines = extract_lines(scan_in(ROOM, pose, rng), LineConfig())
        for ends in lines.ends:
            a, b = se2.transform_points(pose, ends)
            error = [wall_error(wall, a, b) for wall in ROOM]
            assert min(error) < 0.06, (pose, a, b)
            count += 1
    assert count > 150


def wall_error(wall, a, b):
    along = (wall[2:] - wall[:2]) / np.hypot(*(wall[2:] - wall[:2]))
    normal = np.array([-along[1], along[0]])
    inside = all(
        -0.1 <= (p - wall[:2]) @ along <= np.hypot(*(wall[2:] - wall[:2])) + 0.1 for p in (a, b)
    )
    return max(abs((p - wall[:2]) @ normal) for p in (a, b)) if inside else math.inf


def test_a_doorway_parts_a_wall_and_a_lost_beam_does_not():
    wall = np.array([[2.0, -3.0, 2.0, -0.5], [2.0, 0.5, 2.0, 3.0]])
    assert len(extract_lines(scan_in(wall, np.zeros(3)), LineConfig())) == 2
    whole = scan_in(np.array([[2.0, -3.0, 2.0, 3.0]]), np.zeros(3)).ranges_m.copy()
    whole[[60, 90, 91, 120]] = np.inf
    assert len(extract_lines(scan_of(whole), LineConfig())) == 1


def test_a_bend_parts_a_wall_and_a_split_by_noise_is_healed(rng):
    bent = np.array([[3.0, -2.0, 3.0, 0.0], [3.0, 0.0, 2.7, 2.0]])
    assert len(extract_lines(scan_in(bent, np.zeros(3), rng), LineConfig())) == 2
    straight = np.array([[3.0, -2.5, 3.0, 2.5]])
    config = LineConfig(split_distance_m=0.025)
    assert all(
        len(extract_lines(scan_in(straight, np.zeros(3), rng), config)) == 1 for _ in range(50)
    )


@pytest.mark.parametrize(
    'ranges', [[], [1.0], [np.inf] * 181, [np.nan] * 181, [0.0] * 181, [1.0] * 181]
)
def test_scans_without_walls(ranges):
    assert len(extract_lines(scan_of(np.array(ranges)), LineConfig())) == 0
