"""Data association of lines and features, and the creation of features."""

import math

import numpy as np
import pytest
from scipy.stats import chi2
from support.slam_room import BLIND, ROOM, drive, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.ekf import CompressedEkf, EkfSlam
from thinmap_ros.core.ekf_slam.feature_map import (
    MAX_MISSES,
    AssociationConfig,
    FeatureConfig,
    FeatureMap,
    associate,
    mahalanobis,
)
from thinmap_ros.core.ekf_slam.features import FeatureTrack, LineConfig, Lines, extract_lines

R = np.diag([0.02**2, 0.01**2])
SURE = 1e-8 * np.eye(3)


def seen_lines(*walls):
    """Lines of a scan from walls given by their end points, robot frame."""
    ends = np.array(walls, dtype=float).reshape(-1, 2, 2)
    along = ends[:, 1] - ends[:, 0]
    normals = np.column_stack([-along[:, 1], along[:, 0]]) / np.hypot(*along.T)[:, None]
    r = (normals * ends[:, 0]).sum(axis=1)
    normals = np.where(r[:, None] < 0.0, -normals, normals)
    z = np.column_stack([np.abs(r), np.arctan2(normals[:, 1], normals[:, 0])])
    return Lines(z, np.tile(R, (len(z), 1, 1)), ends)


def known(walls, pose=(0.0, 0.0, 0.0), P=SURE):
    """A filter with some walls as features, and their tracks."""
    lines = seen_lines(*walls)
    ekf = CompressedEkf(np.array(pose), P)
    features = FeatureMap(
        FeatureConfig(min_observations=1), AssociationConfig(max_gap_m=0.3), local_areas=False
    )
    features.observe(ekf, lines, BLIND)
    return ekf, features


def test_the_gate_lets_95_of_100_true_matches_pass(rng):
    S = np.array([[4e-4, 1e-4], [1e-4, 3e-4]])
    distances = [mahalanobis(v, S) for v in rng.multivariate_normal([0.0, 0.0], S, 4000)]
    assert np.mean(np.array(distances) <= AssociationConfig().gate) == pytest.approx(0.95, abs=0.01)
    assert AssociationConfig().gate == pytest.approx(chi2.ppf(0.95, 2), abs=0.01)
    v = np.array([0.03, -0.02])
    assert mahalanobis(v, S) == pytest.approx(v @ np.linalg.solve(S, v))
    assert mahalanobis(v, -S) == math.inf
    assert mahalanobis(v, np.zeros((2, 2))) == math.inf
    assert mahalanobis(np.ones(2), np.ones((2, 2))) == math.inf


def chosen(walls, seen, gap_m=0.3):
    ekf = EkfSlam(np.zeros(3), SURE)
    features = []
    for line, ends in zip(seen_lines(*walls).z, np.array(walls).reshape(-1, 2, 2), strict=True):
        ekf.add(line, 1e-6 * np.eye(2))
        along = ends @ [-math.sin(line[1]), math.cos(line[1])]
        features.append(FeatureTrack(1, along.min(), along.max(), np.zeros(2)))
    return associate(
        ekf, features, seen_lines(*seen), np.zeros(2), AssociationConfig(max_gap_m=gap_m)
    ).index.tolist()


def test_collinear_walls_of_two_rooms_are_two():
    assert chosen(
        [[[2, 1], [2, 3]], [[2, -3], [2, -1]]], [[[2, -2.5], [2, -1.2]], [[2, 1.5], [2, 2]]]
    ) == [1, 0]
    assert chosen([[[2, 1], [2, 3]]], [[[2, -3], [2, -1]]]) == [-1]
    assert chosen([[[2, 1], [2, 3]]], [[[2, -3], [2, -1]]], gap_m=2.5) == [0]


def test_pieces_of_a_wall_beside_a_door_are_one_feature():
    left = [[2, 1], [2, 3]]
    right = [[2, -3], [2, 0]]
    gap_m = AssociationConfig().max_gap_m
    assert chosen([left], [right], gap_m) == [0]
    assert chosen([left], [[[2.0, -3.0], [2.0, 0.9 - gap_m]]], gap_m) == [-1]


def test_the_direction_of_a_short_wall_is_uncertain():
    """4 m of a wall, observed at 20 mrad, rotate the pose over twice as much as 0.5 m."""
    turned = []
    for length_m in (0.5, 4.0):
        ekf, features = known([[[2.0, -4.0], [2.0, 4.0]]])
        ekf.local.set_pose(np.zeros(3), np.diag([1e-6, 1e-6, 4e-4]))
        half = 0.5 * length_m
        seen = seen_lines([[2.0 - 0.02 * half, -half], [2.0 + 0.02 * half, half]])
        features.observe(ekf, Lines(seen.z, 1e-3 * R[None], seen.ends), BLIND)
        turned.append(abs(float(ekf.local.pose[2])))
    assert turned[1] > 0.01
    assert turned[0] < 0.5 * turned[1]


def test_only_lines_within_the_gate_are_associated():
    assert chosen([[[2, -1], [2, 1]]], [[[2.03, -1], [2.03, 1]]]) == [0]
    assert chosen([[[2, -1], [2, 1]]], [[[2.2, -1], [2.2, 1]]]) == [-1]
    assert chosen([[[2, -1], [2, 1]]], [[[2.2, -1], [1.8, 1]]]) == [-1]
    assert chosen([], [[[2, -1], [2, 1]]]) == [-1]


def test_what_could_be_two_walls_is_decided_when_the_others_have_corrected_the_pose():
    """A cupboard 12 cm in front of a wall: alone, its line is nearer to the wrong feature."""
    wall = [[2.12, -1.0], [2.12, 1.0]]
    cupboard = [[2.0, -1.0], [2.0, 1.0]]
    behind = [[-3.0, -1.0], [-3.0, 1.0]]
    ekf, features = known([wall, cupboard, behind])
    truth = np.array([0.08, 0.0, 0.0])
    ekf.local.set_pose(np.zeros(3), np.diag([0.1**2, 0.01**2, 0.001**2]))
    off = [truth[:2], truth[:2]]
    seen = seen_lines(np.array(wall) - off, np.array(behind) - off)
    alone = associate(ekf.local, features._local(ekf), seen, np.zeros(2), AssociationConfig())
    assert ekf.area[alone.index[0]] == 2
    assert alone.ambiguous.tolist() == [True, False]
    features.observe(ekf, seen, BLIND)
    assert ekf.local.pose[0] == pytest.approx(0.08, abs=0.02)


def test_the_two_faces_of_a_thin_wall_are_two_features():
    ekf, features = known([[[2.0, -2.0], [2.0, 2.0]]])
    ekf.local.set_pose(np.array([4.0, 0.0, math.pi]), SURE)
    for _ in range(3):
        features.observe(ekf, seen_lines([[1.95, -2.0], [1.95, 2.0]]), BLIND)
    faces = sorted(f.r_m for f in features.line_features(ekf))
    assert faces == pytest.approx([2.0, 2.05], abs=0.01)


def test_a_feature_enters_after_several_sightings_and_keeps_its_id():
    ekf = CompressedEkf(np.zeros(3), SURE)
    features = FeatureMap(FeatureConfig(min_observations=3), AssociationConfig(), local_areas=False)
    wall = seen_lines([[2.0, -1.0], [2.0, 1.0]])
    counts = []
    for _ in range(5):
        features.observe(ekf, wall, BLIND)
        counts.append(len(features))
    assert counts == [0, 0, 1, 1, 1]
    (only,) = features.line_features(ekf)
    features.observe(ekf, seen_lines([[2.0, -1.0], [2.0, 2.5]]), BLIND)
    (grown,) = features.line_features(ekf)
    assert grown.id == only.id
    assert {round(float(p[1]), 1) for p in (grown.start, grown.end)} == {-1.0, 2.5}


def test_a_wall_that_the_odometry_has_turned_out_of_its_gate_is_no_second_feature():
    """A duplicate would confirm the wrong heading for ever."""
    ekf, features = known([[[3.0, 1.0], [3.0, 5.0]]])
    ekf.local.set_pose(np.array([0.0, 0.0, 0.06]), np.diag([1e-6, 1e-6, 0.01**2]))
    wall = seen_lines([[3.0, 1.0], [3.0, 5.0]])
    features.observe(ekf, wall, BLIND)
    assert ekf.local.pose[2] == pytest.approx(0.06)
    assert len(ekf) == 1
    ekf.local.predict(ekf.local.pose, np.zeros(3), np.diag([1e-6, 1e-6, 0.03**2]))
    features.observe(ekf, wall, BLIND)
    assert ekf.local.pose[2] == pytest.approx(0.0, abs=0.02)
    assert len(ekf) == 1


def test_what_is_not_confirmed_yet_corrects_the_pose_and_is_not_in_a_session():
    ekf = CompressedEkf(np.zeros(3), SURE)
    features = FeatureMap(FeatureConfig(), AssociationConfig(), local_areas=False)
    wall = seen_lines([[3.0, -2.0], [3.0, 2.0]])
    features.observe(ekf, wall, BLIND)
    ekf.local.set_pose(np.array([0.0, 0.0, 0.06]), np.diag([1e-6, 1e-6, 0.04**2]))
    features.observe(ekf, wall, BLIND)
    assert ekf.local.pose[2] == pytest.approx(0.0, abs=0.01)
    assert len(ekf) == 1
    assert not features.line_features(ekf)
    state = features.state(ekf)
    assert not state['ids'].size
    assert not state['stored_at'].size


def test_what_was_seen_once_and_then_no_more_is_forgotten():
    ekf = CompressedEkf(np.zeros(3), SURE)
    features = FeatureMap(
        FeatureConfig(min_observations=2, candidate_max_misses=3),
        AssociationConfig(),
        local_areas=False,
    )
    passer_by = seen_lines([[1.0, -0.5], [1.0, 0.5]])
    wall = seen_lines([[4.0, -1.0], [4.0, 1.0]])
    features.observe(ekf, passer_by, BLIND)
    for _ in range(5):
        features.observe(ekf, wall, BLIND)
    features.observe(ekf, passer_by, BLIND)
    assert [round(f.r_m) for f in features.line_features(ekf)] == [4]


@pytest.mark.parametrize(('misses', 'found'), [(3, [1, 4]), (4, [4])])
def test_a_candidate_is_dropped_after_more_misses_than_configured(misses, found):
    ekf = CompressedEkf(np.zeros(3), SURE)
    config = FeatureConfig(min_observations=2, candidate_max_misses=3)
    features = FeatureMap(config, AssociationConfig(), local_areas=False)
    seldom_seen = seen_lines([[1.0, -0.5], [1.0, 0.5]])
    wall = seen_lines([[4.0, -1.0], [4.0, 1.0]])
    for lines in (seldom_seen, *[wall] * misses, seldom_seen):
        features.observe(ekf, lines, BLIND)
    assert sorted(round(f.r_m) for f in features.line_features(ekf)) == found


def test_two_features_that_turn_out_to_be_one_wall_merge():
    ekf, features = known(
        [[[2.0, -3.0], [2.0, -1.0]], [[2.0, 1.0], [2.0, 3.0]], [[-1.0, 2.0], [1.0, 2.0]]]
    )
    first = min(f.id for f in features.line_features(ekf))
    assert len(features) == 3
    features.observe(ekf, seen_lines([[2.0, -1.5], [2.0, 1.5]]), BLIND)
    assert len(features) == 2 == len(ekf)
    (long,) = [f for f in features.line_features(ekf) if f.id == first]
    assert sorted([long.start[1], long.end[1]]) == pytest.approx([-3.0, 3.0], abs=0.02)


def test_a_line_askew_on_a_known_wall_fails_the_gate_and_is_no_second_feature():
    ekf, features = known([[[3.0, -1.0], [3.0, 3.0]]])
    features.observe(ekf, seen_lines([[3.09, 0.2], [2.91, 1.8]]), BLIND)
    assert len(features) == 1


@pytest.mark.parametrize('local_areas', [False, True])
def test_a_drive_through_a_room_finds_its_walls_once(rng, local_areas):
    """All features are walls, without duplicates."""
    truths = [truth for truth, _ in drive(500, rng, np.array([2.0, 2.0, 0.0]))][::3]
    ekf = CompressedEkf(truths[0], SURE)
    features = FeatureMap(FeatureConfig(), AssociationConfig(max_gap_m=0.3), local_areas)
    for truth in truths:
        ekf.local.set_pose(truth, SURE)
        scan = scan_in(ROOM, truth, rng)
        features.observe(ekf, extract_lines(scan, LineConfig()), scan)
    walls = [wall_of(feature) for feature in features.line_features(ekf)]
    assert -1 not in walls
    assert len(walls) >= 7
    inner = (4, 5)  # walls with two faces
    assert all(walls.count(w) <= (2 if w in inner else 1) for w in walls)


def wall_of(feature):
    for index, wall in enumerate(ROOM):
        along = (wall[2:] - wall[:2]) / np.hypot(*(wall[2:] - wall[:2]))
        off = [
            abs((end - wall[:2]) @ [-along[1], along[0]]) for end in (feature.start, feature.end)
        ]
        inside = [
            -0.2 < (end - wall[:2]) @ along < np.hypot(*(wall[2:] - wall[:2])) + 0.2
            for end in (feature.start, feature.end)
        ]
        if max(off) < 0.06 and all(inside):
            return index
    return -1


def test_features_follow_the_filter_not_the_robot():
    ekf, features = known([[[2.0, -1.0], [2.0, 1.0]]])
    before = features.line_features(ekf)[0]
    ekf.local.set_pose(se2.pose(1.0, 0.5, 0.3), SURE)
    after = features.line_features(ekf)[0]
    np.testing.assert_array_equal(before.start, after.start)


def test_a_door_that_opens_leaves_the_map_and_a_wall_behind_a_person_does_not():
    door = [[2.0, -1.0], [2.0, 1.0]]
    far = [[5.0, -3.0], [5.0, 3.0]]
    ekf, features = known([door])
    person = np.array([[1.0, -0.8, 1.0, 0.8], [*far[0], *far[1]]])
    for _ in range(10):
        features.observe(ekf, seen_lines(far), scan_in(person, np.zeros(3)))
    assert sorted(round(f.r_m) for f in features.line_features(ekf)) == [2, 5]
    for _ in range(MAX_MISSES):
        assert len(features) == 2
        features.observe(ekf, seen_lines(far), scan_in(person[1:], np.zeros(3)))
    left = features.line_features(ekf)
    assert [round(f.r_m) for f in left] == [5] == [f.id + 3 for f in left]
    assert len(ekf) == 1


def test_glass_is_not_taken_for_an_open_door():
    ekf, features = known([[[2.0, -1.0], [2.0, 1.0]]])
    for _ in range(20):
        features.observe(ekf, seen_lines(), BLIND)
    assert len(features) == 1
