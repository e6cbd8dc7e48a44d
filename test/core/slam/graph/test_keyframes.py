"""Keyframes: their reuse, and the covariances of their poses."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import inverse, propagated_covariance, rotated_covariance
from thinmap_ros.core.slam.graph import keyframes as module
from thinmap_ros.core.slam.graph.keyframes import (
    Keyframe,
    KeyframeConfig,
    Keyframes,
    Start,
    Step,
    covariances_from,
    heading_errors,
    view_difference_m,
    with_heading,
)
from thinmap_ros.core.slam.graph.pose_graph import NO_SHARE, Edge, Systematic
from thinmap_ros.core.slam.graph.tables import EdgeTable, heading_row
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.slam.wall_compass import Heading, Reference

STEP = np.diag(np.square([0.02, 0.01, 0.01]))
MAP = 0.005**2  # variance of the main wall direction of the map
REFERENCE = Reference(MAP, NO_SHARE)


def frame(pose, path_m=0.0, stamp_ns=0, covariance=None):
    pose = np.asarray(pose, dtype=np.float64)
    scan = scan_in(ROOM, pose, stamp_ns=stamp_ns)
    covariance = np.zeros((3, 3)) if covariance is None else covariance
    return Keyframe(scan, surface_points(scan), pose, path_m, covariance, 0)


def along(poses, steps=STEP):
    keyframes = Keyframes(KeyframeConfig())
    for k, pose in enumerate(poses):
        keyframes.add(frame(pose, float(k), k), Step(steps))
    return keyframes


def move(keyframes, poses, edges):
    for _ in keyframes.move(poses, edges):
        raise AssertionError('few keyframes move in one slice')


def independent(variance):
    """Error (6,) of a heading that is measured by a direction without error."""
    return np.array([variance, 0.0, 0.0, 0.0, 0.0, 0.0])


def random_covariance(rng, size=0.02):
    root = rng.normal(0.0, size, (3, 3))
    return root @ root.T + 1e-6 * np.eye(3)


def test_a_chain_of_keyframes_has_a_step_to_each_from_its_anchor():
    poses = [se2.pose(k, 0.5 * k, 0.3 * k) for k in range(5)]
    keyframes = along(poses)
    assert len(keyframes) == 5
    assert keyframes.anchor == 4
    assert [(e.a, e.b) for e in keyframes.steps] == [(0, 1), (1, 2), (2, 3), (3, 4)]
    for edge in keyframes.steps:
        np.testing.assert_allclose(edge.T_a_b, se2.between(poses[edge.a], poses[edge.b]))
        np.testing.assert_allclose(edge.information @ STEP, np.eye(3), atol=1e-9)
        assert not edge.robust
    np.testing.assert_array_equal(keyframes.poses(), poses)


def test_before_the_first_there_is_no_anchor():
    keyframes = Keyframes(KeyframeConfig())
    assert keyframes.anchor == -1
    assert keyframes.poses().shape == (0, 3)
    assert keyframes.most_similar(np.zeros(3)) is None
    stamps, poses = keyframes.path()
    assert stamps.shape == (0,)
    assert poses.shape == (0, 3)


def test_an_earlier_keyframe_stands_for_one_that_sees_the_same():
    keyframes = along([se2.pose(k, 1.0, 0.0) for k in range(4)])
    back = frame([1.1, 1.05, 0.1], path_m=9.0, stamp_ns=77)
    keyframes.reuse(1, back)
    assert len(keyframes) == 4
    assert keyframes.anchor == 1
    assert keyframes.frames[1].path_m == 9.0
    np.testing.assert_array_equal(keyframes.frames[1].T_map_base, [1.0, 1.0, 0.0])
    stamps, poses = keyframes.path()
    assert stamps.tolist() == [0, 1, 2, 3, 77]
    np.testing.assert_allclose(poses[-1], back.T_map_base)
    # The next edge starts at the reused keyframe.
    number = keyframes.add(frame([1.0, 2.0, 0.0], 10.0), Step(STEP))
    assert (keyframes.steps[-1].a, keyframes.steps[-1].b) == (1, number)


def test_scans_for_which_a_keyframe_stands_go_where_it_goes():
    keyframes = along([se2.pose(k, 1.0, 0.0) for k in range(4)])
    keyframes.reuse(1, frame([1.1, 1.05, 0.1], stamp_ns=77))
    offset = se2.between(keyframes.frames[1].T_map_base, np.array([1.1, 1.05, 0.1]))
    moved = keyframes.poses() + [0.5, -0.2, 0.4]
    move(keyframes, moved, EdgeTable())
    np.testing.assert_allclose(keyframes.path()[1][-1], se2.compose(moved[1], offset))
    assert keyframes.most_similar(moved[2]) == 2


@pytest.mark.parametrize(
    ('T', 'apart'),
    [
        ((0.69, 0.0, 0.0), False),
        ((0.0, -0.71, 0.0), True),
        ((0.5, 0.5, 0.0), True),
        ((0.0, 0.0, 0.69), False),
        ((0.0, 0.0, -0.71), True),
    ],
)
def test_poses_differ_by_distance_or_by_angle(T, apart):
    keyframes = Keyframes(KeyframeConfig())
    for start in (np.zeros(3), np.array([3.0, -2.0, 3.1])):
        there = se2.compose(start, np.array(T))
        assert keyframes.differ(start, there) is apart
        assert keyframes.differ(there, start) is apart


def test_the_most_similar_keyframe_is_found():
    keyframes = along([se2.pose(0.3 * k, 0.0, 0.2 * k) for k in range(10)])
    pose = np.array([1.25, 0.05, 0.78])
    assert keyframes.most_similar(pose) == min(
        range(10), key=lambda k: view_difference_m(keyframes.frames[k].T_map_base, pose)
    )
    assert keyframes.most_similar(np.array([50.0, 0.0, 0.0])) is None
    assert keyframes.most_similar(np.array([0.3, 0.0, 2.5])) is None


def test_unlike_wraps():
    assert view_difference_m(np.array([0.0, 0.0, 3.1]), np.array([0.0, 0.0, -3.1])) < 0.1
    assert view_difference_m(np.zeros(3), np.array([3.0, 4.0, 0.5])) == pytest.approx(5.5)


def sampled(chain, covariances, rng, number=20000):
    """Covariance (3, 3) of the end of a chain of relative poses with noise, by sampling."""
    poses = np.zeros((number, 3))
    for T, covariance in zip(chain, covariances, strict=True):
        noisy = T + rng.multivariate_normal(np.zeros(3), covariance, number)
        c = np.cos(poses[:, 2])
        s = np.sin(poses[:, 2])
        poses = np.column_stack(
            [
                poses[:, 0] + c * noisy[:, 0] - s * noisy[:, 1],
                poses[:, 1] + s * noisy[:, 0] + c * noisy[:, 1],
                poses[:, 2] + noisy[:, 2],
            ]
        )
    return np.cov(poses.T)


def test_covariances_along_a_chain_are_those_of_sampling(rng):
    chain = [np.array([1.0, 0.2, 0.4]), np.array([2.0, -0.5, -0.9]), np.array([0.5, 1.0, 0.3])] * 2
    covariances = [random_covariance(rng) for _ in chain]
    poses = [np.zeros(3)]
    keyframes = Keyframes(KeyframeConfig())
    keyframes.add(frame(poses[0]), Step(STEP))
    for k, (T, covariance) in enumerate(zip(chain, covariances, strict=True)):
        poses.append(se2.compose(poses[-1], T))
        keyframes.add(frame(poses[-1], float(k)), Step(covariance))
    move(keyframes, np.array(poses), EdgeTable())
    truth = sampled(chain, covariances, rng)
    found = keyframes.frames[-1].covariance
    scale = np.sqrt(np.outer(np.diag(truth), np.diag(truth)))
    np.testing.assert_allclose(found / scale, truth / scale, atol=0.06)
    np.testing.assert_allclose(keyframes.frames[0].covariance, 0.0)
    traces = [np.trace(each.covariance) for each in keyframes.frames]
    assert (np.diff(traces) > 0.0).all()


def test_an_edge_that_closes_a_loop_leaves_less_uncertainty():
    """The chain of smallest variance counts: at the start this is the loop edge."""
    angles = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
    poses = np.column_stack([3 * np.cos(angles), 3 * np.sin(angles), se2.wrap(angles + np.pi / 2)])
    keyframes = along(poses)
    move(keyframes, poses, EdgeTable())
    alone = [np.trace(each.covariance[:2, :2]) for each in keyframes.frames]
    loop = Edge(0, 19, se2.between(poses[0], poses[19]), inverse(STEP), True)
    move(keyframes, poses, EdgeTable([loop]))
    closed = [np.trace(each.covariance[:2, :2]) for each in keyframes.frames]
    assert closed[19] == pytest.approx(alone[1], rel=0.3)
    assert np.argmax(closed) in (9, 10, 11)
    assert all(b <= a + 1e-12 for a, b in zip(alone, closed, strict=True))
    # Edges to keyframes that are not part of the optimization are ignored.
    move(keyframes, poses[:10], EdgeTable([loop]))
    assert np.trace(keyframes.frames[9].covariance[:2, :2]) == pytest.approx(alone[9])


def test_a_loop_measured_the_other_way_is_turned_round(rng):
    """An edge in reverse direction, 3 m long: its heading error acts over this distance."""
    poses = np.array([[0.0, 0.0, 0.4], [3.0, 0.5, 1.3]])
    T = se2.between(poses[1], poses[0])
    covariance = np.diag(np.square([0.02, 0.01, 0.05]))
    keyframes = along(poses, 1e6 * np.eye(3))
    move(keyframes, poses, EdgeTable([Edge(1, 0, T, inverse(covariance), True)]))
    measured = T + rng.multivariate_normal(np.zeros(3), covariance, 20000)
    truth = np.cov([se2.compose(poses[0], se2.invert(each)) for each in measured], rowvar=False)
    found = keyframes.frames[1].covariance
    scale = np.sqrt(np.outer(np.diag(truth), np.diag(truth)))
    np.testing.assert_allclose(found / scale, truth / scale, atol=0.06)


def test_a_turned_covariance_is_that_of_turned_samples(rng):
    covariance = random_covariance(rng)
    theta = 0.7
    samples = rng.multivariate_normal(np.zeros(3), covariance, 20000)
    c = math.cos(theta)
    s = math.sin(theta)
    samples[:, :2] = samples[:, :2] @ np.array([[c, s], [-s, c]])
    np.testing.assert_allclose(rotated_covariance(covariance, theta), np.cov(samples.T), atol=3e-5)
    np.testing.assert_allclose(
        rotated_covariance(rotated_covariance(covariance, theta), -theta), covariance, atol=1e-12
    )


def test_a_carried_covariance_is_that_of_what_is_bound_to_it(rng):
    covariance = random_covariance(rng)
    lever = np.array([2.0, -1.0])
    samples = rng.multivariate_normal(np.zeros(3), covariance, 20000)
    c = np.cos(samples[:, 2])
    s = np.sin(samples[:, 2])
    ends = np.column_stack(
        [
            samples[:, 0] + c * lever[0] - s * lever[1],
            samples[:, 1] + s * lever[0] + c * lever[1],
            samples[:, 2],
        ]
    )
    np.testing.assert_allclose(propagated_covariance(covariance, lever), np.cov(ends.T), atol=2e-4)
    np.testing.assert_array_equal(propagated_covariance(covariance, np.zeros(2)), covariance)


def test_covariances_along_the_graph_are_the_same_in_plain_python(rng, monkeypatch):
    poses = np.column_stack([rng.uniform(-5, 5, (12, 2)), rng.uniform(-3, 3, 12)])
    pairs = [(i, i + 1) for i in range(10)] + [(8, 2), (0, 7)]
    edges = []
    for a, b in pairs:
        A = rng.normal(0.0, 1.0, (3, 3))
        information = inverse(A @ A.T * 1e-3 + 1e-4 * np.eye(3))
        share = Systematic(rng.normal(0.0, 1.0, (3, 4)), np.zeros(4), 0)
        edges.append(Edge(a, b, se2.between(poses[a], poses[b]), information, False, share))
    headings = np.where(rng.random(12) < 0.5, rng.uniform(1e-5, 1e-2, 12), np.inf)
    errors = np.column_stack([headings, np.zeros((12, 5))])
    compiled, derivatives = covariances_from(Start(3), poses, [EdgeTable(edges)], errors)
    assert np.isinf(compiled[11]).all(), 'no chain leads there'
    assert (compiled[3] == 0.0).all()
    np.testing.assert_allclose(compiled, np.swapaxes(compiled, 1, 2), atol=1e-12)
    assert (compiled[:11, 2, 2] <= headings[:11] + 1e-12).all()
    monkeypatch.setattr(module, '_covariances', module._covariances.py_func)
    covariances, by = covariances_from(Start(3), poses, [EdgeTable(edges)], errors)
    np.testing.assert_allclose(covariances, compiled, rtol=1e-12)
    np.testing.assert_allclose(by, derivatives, rtol=1e-9, atol=1e-12)


def test_a_measured_heading_turns_the_pose_and_moves_it_nowhere(rng):
    """Its errors are those of a pose whose heading alone is updated, by the best gain for that."""
    covariance = random_covariance(rng)
    derivative = rng.normal(0.0, 1.0, (3, 4))
    variance = 1e-4
    direction = np.array([0.1, -0.2, 0.3, 0.0])
    error = np.array([variance, 0.0, *direction])
    found, by = with_heading(covariance, derivative, error)
    gain = covariance[2, 2] / (covariance[2, 2] + variance)
    turned = np.diag([1.0, 1.0, 1.0 - gain])
    measured = np.diag([0.0, 0.0, gain])
    np.testing.assert_allclose(
        found, turned @ covariance @ turned + variance * measured @ measured, atol=1e-15
    )
    np.testing.assert_allclose(by, turned @ derivative + measured[:, 2:] * direction, atol=1e-12)
    np.testing.assert_array_equal(found[:2, :2], covariance[:2, :2])
    np.testing.assert_array_equal(by[:2], derivative[:2])
    unmeasured, _ = with_heading(covariance, derivative, independent(np.inf))
    np.testing.assert_array_equal(unmeasured, covariance)


def test_the_covariance_of_a_measured_heading_is_one(rng):
    """Also of a pose whose position follows from its heading all but exactly, many times over."""
    lever = np.array([3.0, -8.0, 1.0])
    covariance = 0.1**2 * np.outer(lever, lever) + 1e-9 * np.eye(3)
    for shared in (0.0, 0.005**2):
        found = covariance
        for _ in range(50):
            error = np.array([rng.uniform(1e-6, 1e-2), shared, *np.zeros(4)])
            found, _ = with_heading(found, np.zeros((3, 4)), error)
            np.testing.assert_array_equal(found, found.T)
            assert np.linalg.eigvalsh(found).min() > 0.0


def test_measured_headings_are_no_better_than_the_walls_they_are_measured_by(rng):
    """However often they are measured: their main direction has the heading of early scans."""
    covariance = random_covariance(rng) + np.diag([0.0, 0.0, 0.1])
    derivative = rng.normal(0.0, 1.0, (3, 4))
    direction = np.array([0.0, 0.5, 2.4, 0.0])
    for _ in range(50):
        covariance, derivative = with_heading(
            covariance, derivative, np.array([1e-4, 0.05, *direction])
        )
    assert covariance[2, 2] == pytest.approx(0.05, rel=1e-3)
    np.testing.assert_allclose(derivative[2], direction, atol=1e-3)


def test_a_pose_off_its_measured_heading_is_as_uncertain_as_that():
    heading = Heading(3.1, 1e-4, REFERENCE)
    poses = np.array([[1.0, 2.0, 3.1], [1.0, 2.0, -3.1], [0.0, 0.0, 0.0]])
    near, off, unmeasured = heading_errors(
        np.array([heading_row(each) for each in (heading, heading, None)]), poses
    )
    assert near[:2].tolist() == [pytest.approx(1e-4), MAP]
    assert off[0] == pytest.approx(1e-4 + (2.0 * np.pi - 6.2) ** 2)
    assert unmeasured[0] == np.inf


def test_measured_headings_bound_the_covariance_along_the_path():
    """Without them the lateral error of a straight path grows with its length to the power 3/2."""
    poses = np.array([se2.pose(k, 0.0, 0.0) for k in range(40)])
    blind = along(poses).covariances_from(0, poses, EdgeTable())[0][-1]
    keyframes = Keyframes(KeyframeConfig())
    for k, pose in enumerate(poses):
        kept = replace(frame(pose, float(k), k), heading=Heading(0.0, 0.005**2, REFERENCE))
        keyframes.add(kept, Step(STEP))
    guided = keyframes.covariances_from(0, poses, EdgeTable())[0][-1]
    assert np.sqrt(blind[1, 1]) > 1.0
    assert np.sqrt(guided[1, 1]) < 0.2
    assert np.sqrt(guided[2, 2]) <= 0.0071
    seen_from_there = keyframes.covariances_from(39, poses, EdgeTable())[0][0]
    np.testing.assert_allclose(seen_from_there[0, 0], guided[0, 0], rtol=0.05)
    assert seen_from_there[2, 2] <= 4.0 * 0.005**2


def test_measured_headings_are_edges_from_the_first_keyframe():
    keyframes = Keyframes(KeyframeConfig())
    for k, heading in enumerate([None, Heading(0.45, 1e-4, REFERENCE), None]):
        keyframes.add(
            replace(frame(se2.pose(k, 0.0, 0.4), float(k), k), heading=heading), Step(STEP)
        )
    edges = keyframes.headings()
    assert (edges.a.tolist(), edges.b.tolist(), edges.robust.tolist()) == ([0], [1], [True])
    np.testing.assert_allclose(edges.T_a_b[0, 2], 0.05)
    np.testing.assert_array_equal(edges.information[0], np.diag([0.0, 0.0, 1.0 / (1e-4 + MAP)]))


def test_covariances_reach_what_lies_behind_a_pose_with_two_chains():
    """Pose 1 is found by a bad edge first, and then by a better chain through pose 2."""
    poses = np.array([[float(k), 0.0, 0.0] for k in range(5)])
    variances = {(0, 1): 4.0, (0, 2): 0.1, (2, 1): 0.1, (1, 3): 9.0, (3, 4): 0.1}
    edges = [
        Edge(a, b, se2.between(poses[a], poses[b]), np.diag([1.0, 1.0, 1e6]) / variance, False)
        for (a, b), variance in variances.items()
    ]
    found, _ = covariances_from(Start(0), poses, [EdgeTable(edges)], np.full((5, 6), np.inf))
    np.testing.assert_allclose(found[:, 0, 0], [0.0, 0.2, 0.1, 9.2, 9.3], atol=1e-6)


def test_many_keyframes_move_in_slices_and_all_at_once(monkeypatch):
    """One is reused meanwhile, and one is added, which moves with its anchor."""
    poses = np.array([se2.pose(k, 0.0, 0.0) for k in range(10)])
    whole = along(poses)
    turned = np.array([se2.compose(np.array([1.0, 2.0, 1.5]), T) for T in poses])
    move(whole, turned, EdgeTable())
    monkeypatch.setattr(module, '_MOVED_PER_SLICE', 4)
    keyframes = along(poses)
    slices = keyframes.move(turned, EdgeTable())
    next(slices)
    keyframes.reuse(3, frame([3.0, 0.1, 0.0], path_m=30.0, stamp_ns=30))
    next(slices)
    keyframes.add(frame([4.0, 1.0, 0.5], path_m=31.0, stamp_ns=31), Step(STEP))
    assert keyframes.revision == 0
    np.testing.assert_array_equal(keyframes.poses()[:10], poses)
    assert sum(1 for _ in slices) == 2
    assert keyframes.revision == 1
    np.testing.assert_array_equal(keyframes.poses()[:10], turned)
    for one, other in zip(keyframes.frames[:10], whole.frames, strict=True):
        np.testing.assert_array_equal(one.T_map_base, other.T_map_base)
        np.testing.assert_array_equal(one.covariance, other.covariance)
    assert keyframes.frames[3].path_m == 30.0
    T_3_new = np.array([1.0, 1.0, 0.5])
    np.testing.assert_allclose(
        keyframes.frames[10].T_map_base, se2.compose(turned[3], T_3_new), atol=1e-12
    )
    assert 10 in keyframes.near(keyframes.frames[10].T_map_base, 0.1)
    assert keyframes.near(np.array([20.0, 20.0, 0.0]), 1.0) == []


def test_a_search_for_some_poses_ends_early_and_finds_the_same(rng):
    poses = np.column_stack([np.arange(30.0), rng.uniform(-1.0, 1.0, (30, 2))])
    keyframes = along(poses)
    whole, derivatives = keyframes.covariances_from(20, poses, EdgeTable())
    some, by = keyframes.covariances_from(20, poses, EdgeTable(), [17, 22])
    np.testing.assert_array_equal(some[[17, 22]], whole[[17, 22]])
    np.testing.assert_array_equal(by[[17, 22]], derivatives[[17, 22]])
    assert np.isinf(some[:16]).all() and np.isfinite(whole).all()


def test_calibrated_headings_come_with_the_next_move():
    share = Systematic(np.vstack([np.zeros((2, 4)), [0.0, 2.0, 0.0, 0.0]]), np.zeros(4), 1)
    keyframes = Keyframes(KeyframeConfig())
    for k in range(2):
        heading = Heading(0.2, 1e-4, Reference(MAP, share)) if k else None
        keyframes.add(
            replace(frame([float(k), 0.0, 0.1], float(k), k), heading=heading), Step(STEP)
        )
    parameters = np.array([[0.0, 9.0, 0.0, 0.0], [0.0, 0.05, 0.0, 0.0]])
    assert keyframes.headings(parameters).T_a_b[0, 2] == pytest.approx(0.2)
    assert keyframes.headings().T_a_b[0, 2] == pytest.approx(0.1)
    keyframes.calibrate(parameters)
    keyframes.calibrate(parameters)  # they are already
    assert keyframes.headings().T_a_b[0, 2] == pytest.approx(0.2)
    move(keyframes, keyframes.poses(), EdgeTable())
    assert keyframes.frames[0].heading is None
    yaw, variance, reference = keyframes.frames[1].heading
    assert (yaw, variance, reference.variance) == (pytest.approx(0.3), 1e-4, MAP)
    np.testing.assert_array_equal(reference.systematic.derivative, share.derivative)
    np.testing.assert_array_equal(reference.systematic.parameters, parameters[1])


def test_without_keyframes_there_are_no_headings():
    assert len(Keyframes(KeyframeConfig()).headings()) == 0
