"""Scan-to-map matching: accuracy, and covariance in directions without walls."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import RANGE_MAX_M, ROOM, around, map_of, on_wall, scan_in, seen_in

from thinmap_ros.core import se2
from thinmap_ros.core.slam.matching.local_map import LocalMap, LocalMapConfig
from thinmap_ros.core.slam.matching.scan_matcher import Matcher, MatchingConfig, weighted_points
from thinmap_ros.core.slam.matching.surface import surface_points

TRUTH = np.array([2.0, 2.0, 0.3])
DOUBT = np.diag(np.square([0.1, 0.1, 0.1]))
CORRIDOR = np.array([[-50.0, -1.0, 50.0, -1.0], [50.0, 1.0, -50.0, 1.0]])
MATCHER = Matcher()
LASER = np.zeros(3)


def match(local_map, points, prior, covariance=DOUBT):
    return MATCHER.match(points, LASER, local_map, prior, covariance)


def nearest_minimum(local_map, points, prior, covariance):
    """The match without a global search."""
    scan = weighted_points(points, LASER, LocalMapConfig().resolution_m)
    information = np.linalg.inv(covariance)
    return MATCHER._refined(scan, local_map, prior, prior, information)


def off(match_, truth=TRUTH):
    return se2.pose_difference(match_.pose, truth)


def clutter(rng, number):
    """Random surface points (N, 5), with normals in any direction."""
    points = np.column_stack([rng.uniform(0.3, 2.0, number), rng.uniform(-2.0, 2.0, number)])
    return np.vstack([on_wall(point[None], rng.uniform(0.0, math.pi)) for point in points])


def people(pose, number, rng):
    """Walls (N, 4) of octagonal columns of 40 cm, 0.8 to 2 m in front of a pose."""
    away = rng.uniform(0.8, 2.0, number)
    bearing = rng.uniform(-1.5, 1.5, number) + pose[2]
    middles = pose[:2] + away[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    turns = 0.25 * np.pi * np.arange(9)
    corners = middles[:, None] + 0.2 * np.column_stack([np.cos(turns), np.sin(turns)])
    return np.concatenate([corners[:, :-1], corners[:, 1:]], axis=2).reshape(-1, 4)


def in_corridor(rng):
    return map_of(CORRIDOR, [np.array([x, 0.0, 0.0]) for x in np.linspace(-1, 1, 12)], rng)


@pytest.fixture
def room(rng):
    return map_of(ROOM, around(TRUTH, 15, rng), rng)


def test_the_pose_is_found_from_a_prior_beside_it(rng, room):
    """With a prior error of 10 cm and 5 degrees in every direction."""
    errors = []
    for direction in np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False):
        for turn in np.radians([-5.0, 5.0]):
            shift = 0.1 * np.array([math.cos(direction), math.sin(direction)])
            found = match(room, seen_in(ROOM, TRUTH, rng), TRUTH + [*shift, turn])
            assert found.inlier_ratio > 0.9
            assert found.contradiction_ratio < 0.05
            assert found.prior_weight > 0.9
            errors.append(off(found))
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert rms[:2].max() < 0.012
    assert rms[2] < 0.005


def test_the_errors_are_within_the_covariance(rng, room):
    sigmas = []
    for _ in range(30):
        prior = TRUTH + rng.normal(0.0, [0.05, 0.05, 0.03])
        found = match(room, seen_in(ROOM, TRUTH, rng), prior)
        error = off(found)
        sigmas.append(error @ np.linalg.solve(found.covariance, error))
        assert np.linalg.eigvalsh(found.scan_information).min() > 0.0
    assert np.max(sigmas) < 16.3, 'three degrees of freedom, 99.9 %'


def test_the_covariance_is_that_of_scan_and_prior_together(rng, room):
    prior = TRUTH + [0.05, -0.03, 0.02]
    found = match(room, seen_in(ROOM, TRUTH, rng), prior)
    away = off(found, prior)
    squared = away @ np.linalg.solve(DOUBT, away)
    assert found.prior_weight == pytest.approx(1.0 / (1.0 + squared / 100.0))
    information = found.scan_information + found.prior_weight * np.linalg.inv(DOUBT)
    np.testing.assert_allclose(found.covariance @ information, np.eye(3), atol=1e-9)


def test_with_a_distant_prior_poses_are_searched(rng, room):
    """Half a metre and twenty degrees: only the search finds the pose."""
    missed = 0
    found = 0
    wide = np.diag(np.square([0.3, 0.3, 0.2]))
    shifts = ([0.35, 0.35], [-0.35, 0.35], [0.5, 0.0], [0.0, -0.5], [0.5, -0.5], [-0.5, -0.5])
    for turn in np.radians([-20.0, 20.0]):
        for shift in shifts:
            points = seen_in(ROOM, TRUTH, rng)
            prior = TRUTH + [*shift, turn]
            missed += np.hypot(*off(nearest_minimum(room, points, prior, wide))[:2]) > 0.1
            searched = match(room, points, prior, wide)
            found += np.hypot(*off(searched)[:2]) < 0.02 and abs(off(searched)[2]) < 0.01
    assert missed >= 3
    assert found >= 11


def test_after_wheel_slip_poses_around_the_prior_are_searched(rng):
    """Although the prior is narrow: the inlier ratio is low at it."""
    truth = np.array([4.0, 2.5, 0.5])
    room = map_of(ROOM, around(truth, 15, rng), rng)
    sharp = np.diag(np.square([0.01, 0.01, 0.01]))
    slips = ([0.4, 0.2, 0.4], [-0.4, 0.4, -0.4], [0.4, -0.4, 0.4], [0.0, 0.4, -0.3])
    missed = 0
    found = 0
    for slip in slips:
        points = seen_in(ROOM, truth, rng)
        alone = nearest_minimum(room, points, truth + slip, sharp)
        missed += np.hypot(*off(alone, truth)[:2]) > 0.1
        slipped = match(room, points, truth + slip, sharp)
        error = off(slipped, truth)
        found += np.hypot(*error[:2]) < 0.03 and abs(error[2]) < 0.01
        assert slipped.prior_weight < 0.1, 'it was an outlier'
        assert slipped.cost <= alone.cost
    assert missed >= 2
    assert found == len(slips)


def test_along_a_corridor_the_prior_decides(rng):
    """A smooth wall has no information along itself."""
    for _ in range(12):
        local_map = in_corridor(rng)
        prior = np.array([rng.choice([-0.1, 0.1]), 0.06, 0.02])
        found = match(local_map, seen_in(CORRIDOR, np.zeros(3), rng), prior)
        assert abs(found.pose[0] - prior[0]) < 0.03
        assert abs(found.pose[1]) < 0.02
        assert abs(found.pose[2]) < 0.01
        assert found.scan_information[0, 0] < 0.01 * found.scan_information[1, 1]
        assert found.covariance[0, 0] > 0.3 * DOUBT[0, 0]
        assert found.covariance[1, 1] < 0.02 * DOUBT[1, 1]


def test_a_wide_covariance_is_searched_though_the_nearest_minimum_fits(rng):
    """A smooth corridor, with a door at its end."""
    walls = np.vstack([CORRIDOR, [[4.0, -1.0, 4.0, -0.2]]])
    truth = np.zeros(3)
    local_map = map_of(walls, around(truth, 10, rng), rng)
    points = seen_in(walls, truth, rng)
    prior = np.array([0.6, 0.0, 0.0])
    covariance = np.diag(np.square([0.3, 0.05, 0.02]))
    alone = nearest_minimum(local_map, points, prior, covariance)
    assert alone.inlier_ratio > MATCHER.config.min_inlier_ratio
    assert abs(alone.pose[0]) > 0.3
    assert abs(match(local_map, points, prior, covariance).pose[0]) < 0.03


def test_an_unknown_heading_is_searched_though_the_nearest_minimum_fits(rng):
    """A square room with near rotational symmetry, except for a piece of wall."""
    corners = 3.0 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    walls = np.vstack([np.hstack([corners, np.roll(corners, -1, axis=0)]), [[1.0, 1.0, 1.2, 1.0]]])
    truth = np.zeros(3)
    local_map = map_of(walls, around(truth, 10, rng), rng)
    points = seen_in(walls, truth, rng)
    prior = np.array([0.0, 0.0, 1.2])
    covariance = np.diag(np.square([0.03, 0.03, 0.6]))
    alone = nearest_minimum(local_map, points, prior, covariance)
    assert alone.inlier_ratio > 0.5
    assert abs(alone.pose[2]) > 1.0
    assert abs(match(local_map, points, prior, covariance).pose[2]) < 0.02


def test_in_a_corridor_without_visible_end_the_prior_decides():
    """The previous pose explains all points; at the current pose some are in unobserved cells."""
    truth = np.array([1.0, 0.0, 0.0])
    covariance = np.diag(np.square([0.12, 0.12, 0.02]))
    back = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        local_map = LocalMap()
        for x in np.arange(-10.0, 0.1, 1.0):
            pose = np.array([x, 0.0, 0.0])
            local_map.add_scan(
                surface_points(replace(scan_in(CORRIDOR, pose, rng), max_range_m=6.0)), LASER, pose
            )
        points = surface_points(replace(scan_in(CORRIDOR, truth, rng), max_range_m=6.0))
        found = match(local_map, points, truth, covariance)
        back.append(truth[0] - found.pose[0])
    # At most the prior's sigma: without information along the corridor, the prior decides.
    assert np.sqrt(np.mean(np.square(back))) < 0.12
    assert np.median(np.abs(back)) < 0.05


@pytest.mark.parametrize('away_m', [0.3, 0.6, 1.5])
def test_a_scan_in_one_room_is_not_matched_with_the_other_face_of_a_wall(rng, away_m):
    """A wall of 10 cm, observed from both rooms: each face is a separate surface."""
    south = [-4.0, 0.0, 4.0, 0.0]
    north = [4.0, 0.1, -4.0, 0.1]
    sides = np.array([[-2.0, -3.0, -2.0, 0.0], [2.5, 3.0, 2.5, 0.1]])
    below = np.array([south, sides[0]])
    above = np.array([north, sides[1]])
    poses = [np.array([x, -away_m, math.pi / 2.0]) for x in np.linspace(-0.5, 0.5, 8)]
    local_map = map_of(below, poses, rng)
    turned = [np.array([x, 0.1 + away_m, -math.pi / 2.0]) for x in np.linspace(-0.5, 0.5, 8)]
    for pose in turned:
        local_map.add_scan(seen_in(above, pose, rng), LASER, pose)
    errors = []
    for walls, truth in ((below, poses[4]), (above, turned[4])):
        for across in (-0.08, -0.05, 0.05, 0.08):
            prior = truth + [0.02, across, 0.02]
            found = match(local_map, seen_in(walls, truth, rng), prior)
            assert found.inlier_ratio > 0.9
            errors.append(off(found, truth)[1])
    assert np.abs(errors).max() < 0.02
    assert abs(np.mean(errors[:4])) < 0.01
    assert abs(np.mean(errors[4:])) < 0.01


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('number', [5, 10, 20])
def test_in_a_crowd_the_prior_holds(seed, number):
    """People in front of the robot hide the walls: chance inliers do not override odometry."""
    rng = np.random.default_rng(seed)
    room = map_of(ROOM, around(TRUTH, 15, rng), rng)
    wheels = np.diag(np.square([0.01, 0.01, 0.01]))
    points = seen_in(np.vstack([ROOM, people(TRUTH, number, rng)]), TRUTH, rng)
    prior = TRUTH + rng.normal(0.0, [0.01, 0.01, 0.01])
    crowd = match(room, points, prior, wheels)
    error = off(crowd)
    assert error @ np.linalg.solve(crowd.covariance, error) < 16.3
    assert np.hypot(*error[:2]) < 0.04
    assert crowd.inlier_ratio + crowd.contradiction_ratio > 0.9
    assert crowd.contradiction_ratio > 0.1
    clean = match(room, seen_in(ROOM, TRUTH, rng), prior, wheels)
    assert np.trace(crowd.scan_information) < np.trace(clean.scan_information), (
        'what is hidden says nothing'
    )


def test_a_search_never_makes_a_match_worse():
    """The search uses a subsample, and may underestimate a cost."""
    searched = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        room = map_of(ROOM, around(TRUTH, 4, rng), rng)
        points = seen_in(np.vstack([ROOM, people(TRUTH, 12, rng)]), TRUTH, rng)
        prior = TRUTH + rng.normal(0.0, 0.05, 3)
        covariance = np.diag(np.square([0.05, 0.05, 0.05]))
        alone = nearest_minimum(room, points, prior, covariance)
        searched += alone.inlier_ratio < MATCHER.config.min_inlier_ratio
        assert match(room, points, prior, covariance).cost <= alone.cost
    assert searched > 40


def test_two_thirds_of_gross_outliers_do_not_pull(rng, room):
    points = np.vstack([seen_in(ROOM, TRUTH, rng)[::2], clutter(rng, 160)])
    found = match(room, points, TRUTH, np.diag(np.square([0.01, 0.01, 0.01])))
    assert np.hypot(*off(found)[:2]) < 0.02
    assert found.inlier_ratio < 0.4


def test_some_outliers_do_not_pull(rng, room):
    """A third of the scan is on a person in front of a wall."""
    scan = scan_in(ROOM, TRUTH, rng)
    ranges = scan.ranges_m.copy()
    ranges[: len(ranges) // 3] = 0.8
    blocked = type(scan).create(
        0, ranges, scan.angle_min_rad, scan.angle_increment_rad, 0.05, RANGE_MAX_M
    )
    points = surface_points(blocked)
    found = match(room, points, TRUTH + [0.05, -0.03, 0.02])
    assert np.hypot(*off(found)[:2]) < 0.025
    assert 0.05 < 1.0 - found.inlier_ratio < 0.6
    assert found.contradiction_ratio > 0.05


def test_a_new_wall_as_wide_as_a_door_does_not_pull_the_robot_to_a_known_one(rng):
    """A closed door 0.3 m in front of a known wall, to which it could be matched."""
    local_map = in_corridor(rng)
    door = np.array([[0.3, 0.7, 1.2, 0.7]])
    points = seen_in(np.vstack([CORRIDOR, door]), np.zeros(3), rng)
    found = match(local_map, points, np.zeros(3), np.diag(np.square([0.01, 0.01, 0.05])))
    assert abs(found.pose[1]) < 0.03
    assert abs(found.pose[0]) < 0.01
    assert found.inlier_ratio < 0.9


def test_beyond_a_door_the_motion_decides_where_nothing_is_known(rng):
    """An unobserved room, seen from its door."""
    south = [np.array([x, y, 0.5]) for x in (1.5, 4.0, 6.0) for y in (1.5, 3.0)]
    local_map = map_of(ROOM, south, rng)
    wheels = np.diag(np.square([0.02, 0.02, 0.02]))
    for _ in range(10):
        truth = np.array([4.1, 5.3, np.pi / 2.0])
        prior = truth + rng.normal(0.0, [0.01, 0.01, 0.01])
        found = match(local_map, seen_in(ROOM, truth, rng), prior, wheels)
        assert found.inlier_ratio < 0.8
        assert np.hypot(*off(found, truth)[:2]) < 0.06
        assert abs(off(found, truth)[2]) < 0.04


def test_what_lies_beyond_the_end_of_a_known_wall_is_no_sign_of_wheel_slip(rng):
    """The wall continues unobserved, 7 cm off by drift: a robot 3.5 m away does not turn to it."""
    known = np.column_stack([np.linspace(-5.0, -0.4, 150), np.full(150, 0.07)])
    beyond = np.column_stack([np.linspace(0.0, 1.2, 21), rng.normal(0.0, 0.01, 21)])
    truth = np.array([0.6, -3.5, math.pi / 2.0])
    local_map = LocalMap()
    for _ in range(5):
        off_wall = rng.normal(0.0, [0.0, 0.01], known.shape)
        local_map.add_scan(on_wall(known + off_wall), np.array([-2.5, -3.5, 0.0]), np.zeros(3))
    points = on_wall(se2.transform_points(se2.invert(truth), beyond), 0.0)
    wheels = np.diag(np.square([0.06, 0.04, 0.023]))
    found = match(local_map, points, truth, wheels)
    assert found.inlier_ratio == found.contradiction_ratio == 0.0
    assert np.hypot(*off(found, truth)[:2]) < 0.06
    assert abs(off(found, truth)[2]) < 0.02


def test_ground_that_is_new_contradicts_nothing(rng, room):
    """Points in unobserved space behind a door do not contradict; in free space they do."""
    elsewhere = match(room, seen_in(ROOM, TRUTH, rng), TRUTH + [50.0, 0.0, 0.0])
    assert elsewhere.contradiction_ratio == elsewhere.inlier_ratio == 0.0
    np.testing.assert_allclose(elsewhere.pose, TRUTH + [50.0, 0.0, 0.0])
    np.testing.assert_allclose(elsewhere.scan_information, 0.0)
    np.testing.assert_allclose(elsewhere.covariance, DOUBT, atol=1e-12)
    ring = np.linspace(-1.2, 1.2, 60)
    open_ground = on_wall(0.8 * np.column_stack([np.cos(ring), np.sin(ring)]))
    inside = match(room, open_ground, TRUTH, np.diag(np.square([0.01, 0.01, 0.01])))
    assert inside.contradiction_ratio > 0.9


def test_a_point_counts_as_much_as_its_spacing():
    points = on_wall(np.column_stack([np.arange(5.0), np.ones(5)]))
    points[:, 4] = [0.01, 0.025, 0.05, 0.3, 2.0]
    scan = weighted_points(points, np.array([0.5, 1.0, 0.0]), LocalMapConfig().resolution_m)
    np.testing.assert_array_equal(scan[:, :2], points[:, :2])
    np.testing.assert_allclose(scan[:, 2], [0.2, 0.5, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(scan[:, 3:], [[1.0, 0.0], *[[-1.0, 0.0]] * 4])
    at_the_laser = weighted_points(
        points[:1], np.array([0.0, 1.0, 0.0]), LocalMapConfig().resolution_m
    )
    assert np.isfinite(at_the_laser).all()


def test_a_scan_of_twice_the_beams_has_no_more_information_at_close_range(room):
    sparse, dense = (
        match(room, surface_points(scan_in(ROOM, TRUTH, beams=beams)), TRUTH).scan_information
        for beams in (721, 1441)
    )
    np.testing.assert_allclose(np.diag(dense), np.diag(sparse), rtol=0.4)


def test_the_same_input_gives_the_same_output_and_stays_as_it_is(rng, room):
    points = seen_in(ROOM, TRUTH, rng)
    prior = TRUTH + [0.4, 0.3, 0.2]
    covariance = DOUBT.copy()
    copies = points.copy(), prior.copy(), {k: v.copy() for k, v in room.state().items()}
    first, second = (match(room, points, prior, covariance) for _ in range(2))
    np.testing.assert_array_equal(first.pose, second.pose)
    np.testing.assert_array_equal(first.covariance, second.covariance)
    np.testing.assert_array_equal(points, copies[0])
    np.testing.assert_array_equal(prior, copies[1])
    np.testing.assert_array_equal(covariance, DOUBT)
    for name, array in room.state().items():
        np.testing.assert_array_equal(array, copies[2][name])


def test_a_thin_wall_is_matched_by_the_face_that_is_seen(rng):
    """A scan must not be matched with the other face of a wall of 10 cm."""
    faces = np.array(
        [[2.0, -3.0, 2.0, 3.0], [2.1, -3.0, 2.1, 3.0], [0.0, -3.0, 5.0, -3.0], [0.0, 3.0, 5.0, 3.0]]
    )
    west = np.zeros(3)
    east = np.array([4.0, 0.0, math.pi])
    local_map = map_of(faces[[0, 2, 3]], around(west, 15, rng), rng)
    for _ in range(15):
        local_map.add_scan(seen_in(faces[[1, 2, 3]], east, rng), LASER, east)
    found = match(local_map, seen_in(faces[[1, 2, 3]], east, rng), east)
    assert abs(off(found, east)[0]) < 0.01


def test_wide_headings_are_wrapped(rng):
    """Priors near a half turn."""
    truth = np.array([2.0, 2.0, math.pi - 0.01])
    local_map = map_of(ROOM, around(truth, 15, rng), rng)
    points = seen_in(ROOM, truth, rng)
    for heading in (-math.pi + 0.02, math.pi - 0.04):
        for covariance in (DOUBT, np.diag(np.square([0.3, 0.3, 0.3]))):
            found = match(local_map, points, np.array([2.03, 1.98, heading]), covariance)
            assert abs(found.pose[2]) <= math.pi
            assert abs(se2.wrap(float(found.pose[2] - truth[2]))) < 0.01
            assert np.hypot(*off(found, truth)[:2]) < 0.02


def test_another_configuration_is_used(rng, room):
    """Points with twice the noise have a quarter of the information."""
    points = seen_in(ROOM, TRUTH, rng)
    timid = Matcher(MatchingConfig(noise_m=0.1, kernel_scale_m=0.3))
    less = timid.match(points, LASER, room, TRUTH, DOUBT).scan_information
    np.testing.assert_allclose(
        np.diag(less), 0.25 * np.diag(match(room, points, TRUTH).scan_information), rtol=0.2
    )
