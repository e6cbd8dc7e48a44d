"""Scans against the point map: back to the true pose, honest where walls leave a direction open."""

import math
from dataclasses import replace

import numpy as np
import pytest
from slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.slam.point_map import (
    CENTRE_X,
    CENTRE_Y,
    COUNT,
    LOOSE,
    NORMAL_X,
    NORMAL_Y,
    PointMap,
)
from thinmap_ros.core.slam.scan_matching import Match, MatchConfig, ScanMatcher, likelier

TRUTH = np.array([2.0, 2.0, 0.3])
DOUBT = np.diag([0.1, 0.1, 0.1]) ** 2
CORRIDOR = np.array([[-50.0, -1.0, 50.0, -1.0], [50.0, 1.0, -50.0, 1.0]])


def matcher_of(segments, poses, rng):
    matcher = ScanMatcher(MatchConfig())
    for pose in poses:
        scan = scan_in(segments, pose, rng)
        matcher.add(se2.transform_points(pose, scan.points_base()), pose[:2])
    return matcher


def around(pose, number, rng):
    return [pose + rng.normal(0.0, [0.2, 0.2, 0.2]) for _ in range(number)]


def test_the_pose_is_found_from_a_prior_beside_it(rng):
    matcher = matcher_of(ROOM, around(TRUTH, 15, rng), rng)
    errors = []
    for _ in range(30):
        scan = scan_in(ROOM, TRUTH, rng)
        prior = TRUTH + rng.normal(0.0, [0.08, 0.08, 0.06])
        match = matcher.match(scan.points_base(), np.zeros(2), prior, DOUBT)
        assert match.good
        assert match.fit > 0.9
        errors.append(match.T_map_base - TRUTH)
    assert np.sqrt(np.mean(np.square(errors), axis=0)).max() < 0.012


def test_a_prior_far_off_is_searched_for(rng):
    matcher = matcher_of(ROOM, around(TRUTH, 15, rng), rng)
    found = 0
    for turn in np.radians([-12.0, -8.0, 8.0, 12.0]):
        for shift in ([0.3, 0.25], [-0.3, 0.3]):
            scan = scan_in(ROOM, TRUTH, rng)
            match = matcher.match(scan.points_base(), np.zeros(2), TRUTH + [*shift, turn], DOUBT)
            found += match.good and np.hypot(*(match.T_map_base - TRUTH)[:2]) < 0.05
    assert found >= 7


def test_along_a_corridor_the_odometry_decides(rng):
    matcher = matcher_of(CORRIDOR, [np.array([x, 0.0, 0.0]) for x in np.linspace(-1, 1, 12)], rng)
    prior = np.array([0.1, 0.06, 0.02])
    match = matcher.match(
        scan_in(CORRIDOR, np.zeros(3), rng).points_base(), np.zeros(2), prior, DOUBT
    )
    assert match.good
    assert abs(match.T_map_base[0] - 0.1) < 0.03
    assert abs(match.T_map_base[1]) < 0.01
    assert match.covariance[0, 0] > 0.1 * DOUBT[0, 0]
    assert match.covariance[1, 1] < 0.01 * DOUBT[1, 1]


def test_another_place_is_no_good_fit(rng):
    matcher = matcher_of(ROOM, around(TRUTH, 15, rng), rng)
    clutter = np.column_stack([rng.uniform(0.5, 4.0, 150), rng.uniform(-3.0, 3.0, 150)])
    assert not matcher.match(clutter, np.zeros(2), TRUTH, DOUBT).good


def test_without_points_or_map_the_prior_is_given_back(rng):
    empty = ScanMatcher(MatchConfig()).match(np.ones((100, 2)), np.zeros(2), TRUTH, DOUBT)
    blind = matcher_of(ROOM, [TRUTH], rng).match(np.empty((0, 2)), np.zeros(2), TRUTH, DOUBT)
    for match in (empty, blind):
        assert not match.good
        np.testing.assert_array_equal(match.T_map_base, TRUTH)
        np.testing.assert_array_equal(match.covariance, DOUBT)


def test_a_thin_wall_is_matched_by_the_face_that_is_seen(rng):
    """From the far side of a wall 10 cm thick the near face must not draw the scan through it."""
    faces = np.array(
        [[2.0, -3.0, 2.0, 3.0], [2.1, -3.0, 2.1, 3.0], [0.0, -3.0, 5.0, -3.0], [0.0, 3.0, 5.0, 3.0]]
    )
    west, east = np.zeros(3), np.array([4.0, 0.0, math.pi])
    matcher = matcher_of(faces[[0, 2, 3]], around(west, 15, rng), rng)
    scan = scan_in(faces[[1, 2, 3]], east, rng)
    for _ in range(15):
        matcher.add(se2.transform_points(east, scan.points_base()), east[:2])
    match = matcher.match(
        scan_in(faces[[1, 2, 3]], east, rng).points_base(), np.zeros(2), east, DOUBT
    )
    assert abs(match.T_map_base[0] - 4.0) < 0.01


@pytest.mark.parametrize('angle', np.linspace(0.0, math.pi, 7))
def test_surfaces_of_the_point_map_have_the_wall_s_normal(rng, angle):
    normal = np.array([math.cos(angle), math.sin(angle)])
    along = np.array([-normal[1], normal[0]])
    points = (
        3.0 * normal
        + np.linspace(-1.0, 1.0, 400)[:, None] * along
        + rng.normal(0.0, 0.01, (400, 1)) * normal
    )
    point_map = PointMap(0.05, 30.0)
    point_map.add(points, np.zeros(2))
    cells = point_map.cells
    cells = cells[
        (cells[:, COUNT] > 0.0) & (np.abs(cells[:, CENTRE_X : CENTRE_X + 2] @ along) < 0.7)
    ]
    assert len(cells) > 20
    assert (cells[:, LOOSE] == 0.0).all()
    # Turned towards where it was seen from.
    assert (cells[:, NORMAL_X : NORMAL_Y + 1] @ normal < -0.97).all()
    assert np.abs(cells[:, CENTRE_X : CENTRE_X + 2] @ normal - 3.0).max() < 0.015


def test_the_point_map_forgets_what_has_moved():
    point_map = PointMap(0.05, 10.0)
    for x in [1.01] * 50 + [1.04] * 50:
        point_map.add(np.array([[x, 0.02]]), np.zeros(2))
    cells = point_map.cells
    assert cells[cells[:, COUNT] > 0.0, 1] == pytest.approx([1.04], abs=0.003)


def test_beside_a_door_a_wall_is_a_wall_to_its_end():
    """The surface at the end of a wall is the wall's, not one that its jamb has turned."""
    wall = np.column_stack([np.arange(0.0, 2.0, 0.02), np.full(100, 1.0)])
    jamb = np.column_stack([np.full(6, 2.0), 1.0 + 0.02 * np.arange(6)])
    points = PointMap(0.05, 30.0)
    for _ in range(4):
        points.add(np.vstack([wall, jamb]), np.array([1.5, 0.0]))
    cells = points.cells[points.tiles.pool[0, 20, 24:40]]
    for cell in cells:
        assert cell[LOOSE] == 0.0
        np.testing.assert_allclose(
            [cell[NORMAL_X], cell[NORMAL_Y], cell[CENTRE_Y]], [0.0, -1.0, 1.0], atol=0.03
        )


def test_a_match_far_from_its_prior_has_to_be_worth_it():
    prior, covariance = np.zeros(3), np.diag(np.square([0.02, 0.02, 0.02]))
    near, leap = (Match(np.array([x, 0.0, 0.0]), covariance, 0.9, 0.9, True) for x in (0.01, 0.6))
    for fit, overlap, expected in ((0.95, 0.9, near), (0.9, 1.0, near), (1.0, 0.4, near)):
        better = replace(leap, fit=fit, overlap=overlap)
        assert likelier(near, better, prior, covariance, 181) is expected
        assert likelier(better, near, prior, covariance, 181) is expected
    clear = replace(leap, fit=1.0)
    contradicted = replace(near, fit=0.6)
    assert likelier(contradicted, clear, prior, covariance, 181) is clear
    assert likelier(contradicted, clear, prior, covariance, 40) is contradicted
    assert likelier(contradicted, clear, prior, 900.0 * covariance, 40) is clear


def test_a_few_points_of_a_new_wall_do_not_pull_the_robot_to_a_known_one(rng):
    """As through a door: 20 points of a wall a foot before the known one, which they would fit."""
    matcher = matcher_of(CORRIDOR, [np.array([x, 0.0, 0.0]) for x in np.linspace(-1, 1, 12)], rng)
    points = np.column_stack([np.linspace(-0.4, 0.4, 20), np.full(20, 0.7)])
    points = points + rng.normal(0.0, 0.005, (20, 2))
    prior, wheels = np.zeros(3), np.diag(np.square([0.01, 0.01, 0.05]))
    match = matcher.match(points, np.zeros(2), prior, wheels)
    assert not match.good or np.hypot(*match.T_map_base[:2]) < 0.05
    # Of a robot that may be anywhere they tell something.
    match = matcher.match(points, np.zeros(2), prior, wheels, lost=True)
    assert match.good and match.T_map_base[1] == pytest.approx(0.3, abs=0.05)


def test_what_a_map_knows_of_a_scan(rng):
    matcher = matcher_of(ROOM, around(TRUTH, 15, rng), rng)
    points = scan_in(ROOM, TRUTH, rng).points_base()
    assert matcher.known(points, np.zeros(2), TRUTH) > 0.9
    assert matcher.known(points, np.zeros(2), TRUTH + [50.0, 0.0, 0.0]) == 0.0
    assert matcher.known(np.empty((0, 2)), np.zeros(2), TRUTH) == 0.0
    assert ScanMatcher(MatchConfig()).known(points, np.zeros(2), TRUTH) == 0.0
