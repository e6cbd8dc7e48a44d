"""Matching cost, compared with a reference and with numeric differences."""

import math

import numpy as np
import pytest
from support.local_map_cells import read_cells
from support.slam_room import ROOM, around, map_of, on_wall, seen_in

from thinmap_ros.core import se2
from thinmap_ros.core.slam.matching import scan_matcher
from thinmap_ros.core.slam.matching.local_map import (
    HERE,
    MAX_WALL_DISTANCE_M,
    LocalMap,
    LocalMapConfig,
    off_wall,
)
from thinmap_ros.core.slam.matching.scan_matcher import (
    FITS_SIGMAS,
    SLIP_SIGMAS,
    UNSEEN_COST,
    Matcher,
    by_prior,
    evaluate,
    minimize,
    weighted_points,
)

TRUTH = np.array([2.0, 2.0, 0.3])
CORRIDOR = np.array([[-50.0, -1.0, 50.0, -1.0], [50.0, 1.0, -50.0, 1.0]])
MATCHER = Matcher()
SIGMA_M = MATCHER.config.noise_m
WIDTH = MATCHER.config.kernel_scale_m / SIGMA_M
NOISE = (SIGMA_M, WIDTH)
CELL_M = LocalMapConfig().resolution_m
FAR = MAX_WALL_DISTANCE_M / SIGMA_M
DOUBT = np.diag(np.square([0.1, 0.1, 0.1]))
AXES = np.eye(3)


def weighted(points):
    return weighted_points(points, np.zeros(3), CELL_M)


@pytest.fixture
def room(rng):
    return map_of(ROOM, around(TRUTH, 15, rng), rng)


@pytest.fixture
def scan(rng):
    return weighted(seen_in(ROOM, TRUTH, rng))


# The reference: plain, from the description alone.


def cauchy(squared, width):
    return 0.5 * width**2 * math.log1p(squared / width**2)


def cell_at(local_map, row, col):
    return read_cells(local_map, row, col, 1, 1)[0, 0]


def assigned(local_map, scan, pose):
    """For each point: whether its cell was observed, and the mean and cell of its wall, or None."""
    found = []
    for x, y in se2.transform_points(pose, np.ascontiguousarray(scan[:, :2])):
        row = math.floor(y / CELL_M)
        col = math.floor(x / CELL_M)
        cell = cell_at(local_map, row, col)
        if cell['to_row'] == 0:
            found.append((cell['seen'] > 0, None, None))
            continue
        row = row + int(cell['to_row']) - HERE
        col = col + int(cell['to_col']) - HERE
        wall = cell_at(local_map, row, col)
        mean = CELL_M * np.array([col + float(wall['x']), row + float(wall['y'])])
        found.append((cell['seen'] > 0, mean, wall))
    return found


def metric_of(wall):
    """Matrix (2, 2): 1 along the normal, less along the wall for a more certain normal."""
    double = np.array([wall['cos2'], wall['sin2']], dtype=float)
    sure = np.hypot(*double)
    angle = 0.5 * math.atan2(double[1], double[0])
    normal = np.array([math.cos(angle), math.sin(angle)])
    tangent = np.array([-normal[1], normal[0]])
    along = ((1.0 - sure) / (1.0 + sure)) ** 2
    return np.outer(normal, normal) + along * np.outer(tangent, tangent)


def is_behind(point, pose, wall):
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    back = np.array([[c, -s], [s, c]]) @ point[3:]
    return back @ [wall['face_x'], wall['face_y']] < -0.1


HALF_WALL_M = 0.25  # extent of a wall to either side of its hits
OFF_SIGMAS = 3.0  # a point at a larger distance contradicts an observed cell


def reference(local_map, scan, pose):
    """H (3, 3) and sums (5,)."""
    H = np.zeros((3, 3))
    sums = np.zeros(5)
    far = cauchy(FAR**2, WIDTH)
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    for point, (seen, mean, wall) in zip(scan, assigned(local_map, scan, pose), strict=True):
        weight = point[2]
        sums[1] += weight
        if wall is None:
            sums[0] += weight * far * (1.0 if seen else UNSEEN_COST)
            sums[3] += weight * seen
            continue
        if is_behind(point, pose, wall):
            sums[0] += weight * far * UNSEEN_COST
            continue
        arm = np.array([[c, -s], [s, c]]) @ point[:2]
        off = pose[:2] + arm - mean
        metric = metric_of(wall)
        squared = off @ metric @ off / SIGMA_M**2
        share = float(wall['hits']) / (float(wall['hits']) + 1.0)
        sums[0] += weight * share * cauchy(squared, WIDTH)
        sums[4] += weight * (1.0 - share) * far * UNSEEN_COST
        is_beyond = np.hypot(*off) > HALF_WALL_M
        sums[2] += weight * (squared < FITS_SIGMAS**2 and not is_beyond)
        sums[3] += weight * seen * (squared > OFF_SIGMAS**2 or is_beyond)
        J = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]])
        robust = 1.0 / (1.0 + squared / WIDTH**2)
        H += weight * share * robust / SIGMA_M**2 * J.T @ metric @ J
    return H, sums


def is_same_wall(one, other):
    return (one is None) == (other is None) and (one is None or (one == other).all())


def are_alike(local_map, scan, poses):
    """Whether each point has the same wall and is on the same side of it at all poses."""
    first, *rest = [assigned(local_map, scan, pose) for pose in poses]
    for pose, other in zip(poses[1:], rest, strict=True):
        for point, (seen, mean, wall), (seen_2, mean_2, wall_2) in zip(
            scan, first, other, strict=True
        ):
            if not is_same_wall(mean, mean_2) or seen != seen_2:
                return False
            if wall is not None and is_behind(point, poses[0], wall) != is_behind(
                point, pose, wall_2
            ):
                return False
    return True


def strange_scan(rng, number=60):
    """Random points and viewpoints: on walls, in front of and behind them, and far outside."""
    directions = rng.uniform(-math.pi, math.pi, number)
    return np.column_stack(
        [
            rng.uniform(-4.0, 9.0, (number, 2)),
            rng.uniform(0.1, 1.0, number),
            np.cos(directions),
            np.sin(directions),
        ]
    )


def test_the_sums_are_those_of_the_reference(rng, room, scan):
    kinds = np.zeros(5)
    for k in range(20):
        pose = TRUTH + rng.normal(0.0, [0.2, 0.2, 0.2])
        tried = scan if k % 2 else strange_scan(rng)
        H, _, sums = evaluate(tried, pose, room.lattice, *NOISE)
        expected_H, expected = reference(room, tried, pose)
        np.testing.assert_allclose(sums, expected, rtol=1e-6)
        np.testing.assert_allclose(H, expected_H, rtol=1e-6, atol=1e-6 * np.abs(H).max())
        kinds += sums > 0.0
    assert (kinds >= 10).all(), 'points on walls, in the open, of young walls: all were there'


def test_the_gradient_is_that_of_numeric_differences(rng, room, scan):
    """With a fixed wall for each point: not where the nearest wall changes."""
    step = 1e-6
    compared = 0
    for k in range(24):
        pose = TRUTH + rng.normal(0.0, [0.1, 0.1, 0.1])
        tried = scan if k % 2 else strange_scan(rng)
        beside = [[pose + sign * step * axis for sign in (1.0, -1.0)] for axis in AXES]
        if not are_alike(room, tried, [pose, *(T for pair in beside for T in pair)]):
            continue
        compared += 1
        _, g, _ = evaluate(tried, pose, room.lattice, *NOISE)
        costs = np.array(
            [[evaluate(tried, T, room.lattice, *NOISE)[2][0] for T in pair] for pair in beside]
        )
        numeric = (costs[:, 0] - costs[:, 1]) / (2.0 * step)
        np.testing.assert_allclose(-g, numeric, rtol=1e-4, atol=1e-3)
        assert np.abs(g).min() > 0.1
    assert compared >= 16


def test_the_matrix_is_symmetric_and_positive_semidefinite(rng, room, scan):
    for k in range(40):
        pose = TRUTH + rng.normal(0.0, [0.5, 0.5, 0.5])
        tried = scan if k % 2 else strange_scan(rng, 1 + k % 5)
        H, *_ = evaluate(tried, pose, room.lattice, *NOISE)
        np.testing.assert_array_equal(H, H.T)
        assert np.linalg.eigvalsh(H).min() > -1e-9 * np.trace(H) - 1e-12


@pytest.mark.parametrize('wall_m', [1.003, 1.013, 1.025, 1.041])
@pytest.mark.parametrize('angle', [0.0, 0.7, 2.0])
def test_a_point_is_off_a_wall_along_its_normal_alone(wall_m, angle):
    """Below the cell size, at any distance along the wall from its hits."""
    turn = np.array([0.0, 0.0, angle])
    along = np.arange(-2.0, 2.0, 0.005) + 0.0025
    hits = np.column_stack([along, np.full(len(along), wall_m)])
    local_map = LocalMap()
    local_map.add_scan(on_wall(hits), np.zeros(3), turn)
    for away in (-0.3, -0.1, 0.0, 0.06, 0.2):
        for x in (-1.01, 0.0, 0.43):
            scan = np.array([[x, wall_m - away, 1.0, 0.0, -1.0]])
            H, g, sums = evaluate(scan, turn, local_map.lattice, *NOISE)
            share = 1.0 - sums[4] / (UNSEEN_COST * cauchy(FAR**2, WIDTH))
            # On a slanted wall the mean of a cell's hits is not at its centre.
            assert sums[0] == pytest.approx(
                share * cauchy((away / SIGMA_M) ** 2, WIDTH), rel=1e-3, abs=1e-6
            )
            normal = np.array([-math.sin(angle), math.cos(angle)])
            tangent = np.array([math.cos(angle), math.sin(angle)])
            assert abs(tangent @ g[:2]) < 1e-5 * max(abs(normal @ g[:2]), 1.0)
            assert normal @ g[:2] * away >= -1e-6, 'towards the wall'
            assert tangent @ H[:2, :2] @ tangent < 1e-6 * (normal @ H[:2, :2] @ normal)


@pytest.mark.parametrize('angle', [0.0, 0.4, 0.785, 1.2])
def test_along_a_smooth_corridor_there_is_no_information(rng, angle):
    turn = np.array([0.0, 0.0, angle])
    ends = [se2.transform_points(turn, CORRIDOR[:, k : k + 2]) for k in (0, 2)]
    slanted = np.hstack(ends)
    poses = [se2.compose(turn, np.array([x, 0.0, 0.0])) for x in np.linspace(-1, 1, 12)]
    along = np.array([math.cos(angle), math.sin(angle)])
    across = np.array([-along[1], along[0]])
    for noise, most in ((None, 1e-6), (rng, 0.01)):
        local_map = map_of(slanted, poses, noise)
        H, *_ = evaluate(weighted(seen_in(slanted, turn, noise)), turn, local_map.lattice, *NOISE)
        H = H[:2, :2]
        assert across @ H @ across > 1e3
        assert along @ H @ along < most * (across @ H @ across)


def test_in_a_corner_both_directions_count():
    """If normals differ within a cell, both directions have information."""
    local_map = LocalMap()
    hit = np.array([[1.02, 1.02]])
    scan = np.array([[1.08, 1.06, 1.0, -math.sqrt(0.5), -math.sqrt(0.5)]])
    for angle, rank in ((0.0, 1), (math.pi / 2.0, 2)):
        local_map.add_scan(on_wall(hit, angle), np.zeros(3), np.zeros(3))
        H, g, _ = evaluate(scan, np.zeros(3), local_map.lattice, *NOISE)
        assert np.linalg.matrix_rank(H[:2, :2], tol=1.0) == rank
        assert g[0] < -1.0
        assert (g[1] < -1.0) is np.bool_(rank == 2)


def test_a_wall_with_one_hit_has_half_the_weight():
    scan = np.array([[1.08, 0.02, 1.0, -1.0, 0.0]])
    pulls = []
    for hits in (1, 2, 50):
        local_map = LocalMap()
        for _ in range(hits):
            local_map.add_scan(on_wall(np.array([[1.02, 0.02]]), 0.0), np.zeros(3), np.zeros(3))
        H, g, sums = evaluate(scan, np.zeros(3), local_map.lattice, *NOISE)
        pulls.append([g[0], H[0, 0], sums[0]])
        assert sums[2] == 1.0, 'it fits, however young the wall is'
    expected = np.array([1.0 / 2.0, 2.0 / 3.0, 50.0 / 51.0])
    np.testing.assert_allclose(pulls, expected[:, None] / expected[2] * pulls[2], rtol=1e-9)


def test_the_other_face_of_a_wall_has_no_weight():
    """A beam from behind has hit another surface, which counts as unobserved."""
    local_map = LocalMap()
    local_map.add_scan(on_wall(np.array([[1.02, 0.02]]), 0.0), np.zeros(3), np.zeros(3))
    far = cauchy(FAR**2, WIDTH)
    for back, draws in (((-1.0, 0.0), True), ((0.0, 1.0), True), ((1.0, 0.0), False)):
        scan = np.array([[1.08, 0.02, 0.7, *back]])
        H, g, sums = evaluate(scan, np.zeros(3), local_map.lattice, *NOISE)
        assert (g[0] != 0.0) is np.bool_(draws)
        assert (H != 0.0).any() is np.bool_(draws)
        if not draws:
            np.testing.assert_allclose(sums, [0.7 * far * UNSEEN_COST, 0.7, 0.0, 0.0, 0.0])
    turned = np.array([0.0, 0.0, math.pi])
    scan = np.array([[-1.08, -0.02, 0.7, -1.0, 0.0]])  # the same point, from behind
    assert not evaluate(scan, turned, local_map.lattice, *NOISE)[1].any()


def test_the_prior_pulls_as_its_cost_falls(rng):
    information = np.linalg.inv(DOUBT)
    prior = np.array([1.0, -2.0, 3.1])
    for scale in (0.1, 1.0, 10.0):
        pose = prior + scale * np.array([*rng.normal(0.0, 0.1, 2), 0.1])
        pose[2] = se2.wrap(float(pose[2]))
        pull, weight, cost = by_prior(pose, prior, information)
        off = se2.pose_difference(pose, prior)
        squared = off @ information @ off
        assert cost == pytest.approx(cauchy(squared, SLIP_SIGMAS))
        assert weight == pytest.approx(1.0 / (1.0 + squared / SLIP_SIGMAS**2))
        step = 1e-6
        numeric = [
            by_prior(pose + step * axis, prior, information)[2]
            - by_prior(pose - step * axis, prior, information)[2]
            for axis in AXES
        ]
        np.testing.assert_allclose(pull, np.array(numeric) / (2.0 * step), rtol=1e-5)


def cost_at(local_map, scan, pose, prior, information):
    """Total cost of walls and prior, without and with the share that walls with few hits omit."""
    _, _, sums = evaluate(scan, pose, local_map.lattice, *NOISE)
    cost = sums[0] + by_prior(pose, prior, information)[2]
    return cost, cost + sums[4]


def test_a_minimum_is_one(rng, room, scan):
    """The cost does not exceed that of the start, and the returned sums are those of the result."""
    information = np.linalg.inv(DOUBT)
    settled = 0
    for k in range(60):
        if k == 30:  # points that change their walls at every step, some with a higher cost
            scan = strange_scan(rng)
        start = TRUTH + rng.normal(0.0, 0.1, 3)
        given = start.copy()
        pose, H, sums, weight = minimize(scan, start, TRUTH, information, room.lattice, *NOISE)
        np.testing.assert_array_equal(start, given)
        before, _ = cost_at(room, scan, start, TRUTH, information)
        after, told = cost_at(room, scan, pose, TRUTH, information)
        assert after <= before + 1e-9
        assert sums[0] == pytest.approx(told, rel=1e-9)
        H_there, g, _ = evaluate(scan, pose, room.lattice, *NOISE)
        pull, weight_there, _ = by_prior(pose, TRUTH, information)
        np.testing.assert_allclose(H, H_there, rtol=1e-9, atol=1e-6)
        assert weight == pytest.approx(weight_there)
        step = np.linalg.solve(H + weight * information, g - pull)
        settled += k < 30 and np.abs(step).max() < 2e-3
    assert settled >= 27


def test_with_a_distant_prior_the_walls_decide(rng, room, scan):
    """A distant prior has a small weight: the wheels have slipped."""
    sharp = np.linalg.inv(np.diag(np.square([0.005, 0.005, 0.005])))
    prior = TRUTH + [0.0, 0.4, 0.0]
    pose, _, _, weight = minimize(scan, TRUTH, prior, sharp, room.lattice, *NOISE)
    assert weight < 0.05
    assert np.hypot(*(pose - TRUTH)[:2]) < 0.03
    *_, weight = minimize(scan, TRUTH, TRUTH, sharp, room.lattice, *NOISE)
    assert weight > 0.9


def test_headings_of_minima_are_wrapped(rng):
    """With a start near a half turn, and a prior on the other side of it."""
    truth = np.array([2.0, 2.0, math.pi - 0.01])
    room = map_of(ROOM, around(truth, 15, rng), rng)
    scan = weighted(seen_in(ROOM, truth, rng))
    information = np.linalg.inv(DOUBT)
    for start in (math.pi + 0.03, -math.pi + 0.03, -math.pi - 0.05):
        prior = np.array([2.0, 2.0, -math.pi + 0.01])
        pose, _, _, weight = minimize(
            scan, np.array([2.0, 2.0, start]), prior, information, room.lattice, *NOISE
        )
        assert weight > 0.9, 'the prior is not a turn away'
        assert abs(pose[2]) <= math.pi
        assert abs(se2.wrap(float(pose[2] - truth[2]))) < 0.01


def test_kernels_are_what_they_are_in_plain_python(rng, room, scan, monkeypatch):
    thin = np.ascontiguousarray(np.vstack([scan[::6], strange_scan(rng, 20)]))
    information = np.linalg.inv(DOUBT)
    pose = TRUTH + [0.04, 0.02, -0.03]
    prior = TRUTH
    evaluated = evaluate(thin, pose, room.lattice, *NOISE)
    arguments = (thin, pose, prior, information, room.lattice, *NOISE)
    minimized = minimize(*arguments)
    # A compiled function cannot return a cell to Python.
    monkeypatch.setattr(scan_matcher, 'off_wall', off_wall.py_func)
    for compiled, plain in zip(
        evaluated, evaluate.py_func(thin, pose, room.lattice, *NOISE), strict=True
    ):
        np.testing.assert_allclose(compiled, plain, rtol=1e-6, atol=1e-3)
    for compiled, plain in zip(minimized, minimize.py_func(*arguments), strict=True):
        np.testing.assert_allclose(compiled, plain, rtol=1e-6, atol=1e-3)
