"""Loop closure: a ring is closed by matches with earlier visits, and by nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import ROOM, corridor_ring, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import inverse, propagated_covariance, rotated_covariance
from thinmap_ros.core.slam.graph import loop_closure as keyframe_graph
from thinmap_ros.core.slam.graph import loop_closure as module
from thinmap_ros.core.slam.graph.keyframes import Keyframe, KeyframeConfig, Step
from thinmap_ros.core.slam.graph.loop_closure import (
    LoopClosure,
    LoopClosureConfig,
    largest_consistent,
)
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.matching.local_map import LocalMapConfig
from thinmap_ros.core.slam.matching.scan_matcher import MIN_POINTS, MatchingConfig
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.slam.odometry import OdometryCalibration

SIGMAS = np.array([0.02, 0.02, 0.003])
STEP = np.diag(np.square(SIGMAS))
NONE = np.zeros((3, 3))
DRIFT = (0.005, 0.0, 0.0008)  # per metre: 2.5 sigmas of the steps' covariance after a lap
RING = corridor_ring()
CORNERS = [(38.8, 1.2), (38.8, 18.8), (1.2, 18.8), (1.2, 1.2), (20.0, 1.2)]

OTHER_ROOMS = [(-4.0, 16.0), (-4.0, 6.0), (-4.0, -4.0), (6.0, -4.0), (16.0, -4.0)]


def loop_closure(**config):
    return LoopClosure(
        LoopClosureConfig(**config),
        KeyframeConfig(),
        MatchingConfig(),
        LocalMapConfig(),
        OdometryCalibration(),
    )


def round_the_block(step_m=0.75, laps=1):
    """True poses of a path of more than a lap of the corridor, at each step or 0.5 rad."""
    pose = np.array([3.0, 1.2, 0.0])
    yield pose
    for goal in CORNERS[:4] * laps + CORNERS[4:]:
        while np.hypot(*(goal - pose[:2])) > 0.5:
            off = goal - pose[:2]
            turn = np.clip(se2.wrap(np.arctan2(off[1], off[0]) - pose[2]), -0.5, 0.5)
            ahead = step_m if abs(turn) < 0.3 else 0.2
            pose = se2.compose(pose, np.array([0.0, 0.0, turn]))
            pose = se2.compose(pose, np.array([ahead, 0.0, 0.0]))
            yield pose


def path_m(loops, T_map_base):
    return loops.anchor.path_m_at(loops.anchor.relative(T_map_base))


class Driver:
    """A robot whose odometry drifts, and its loop closure."""

    def __init__(self, walls=RING, seed=6, bias=(0.0, 0.0, 0.0), **config):
        self.rng = np.random.default_rng(seed)
        self.loops = loop_closure(**config)
        self.walls = walls
        self.bias = np.array(bias)
        self.truths = []
        self.corrections = []
        self.largest = 0.0
        self.pose = None
        self.covariance = NONE

    def go(self, truth, works=1):
        """Move to the next true pose; returns the correction, if any."""
        if self.pose is None:
            self.pose = truth
        else:
            step = se2.between(self.truths[-1], truth)
            noise = self.rng.normal(0.0, SIGMAS) + np.hypot(step[0], step[1]) * self.bias
            before = self.pose
            self.pose = se2.compose(before, step + noise)
            own = rotated_covariance(STEP, float(before[2]))
            self.covariance = (
                propagated_covariance(self.covariance, self.pose[:2] - before[:2]) + own
            )
        self.truths.append(truth)
        self.largest = max(self.largest, float(np.hypot(*(self.pose - truth)[:2])))
        scan = scan_in(self.walls, truth, self.rng, len(self.truths) - 1)
        points = surface_points(scan)
        frame = Keyframe(scan, points, self.pose, self.path_m(), self.covariance, 0)
        if len(points) >= MIN_POINTS and self.loops.needs_keyframe(self.from_anchor()):
            self.loops.add(frame, Step(STEP), NONE)
        for _ in range(works):
            T_anchor_base = self.from_anchor()
            correction = self.loops.step()
            if correction is not None:
                self.corrections.append(correction)
                anchor = self.loops.keyframes.anchor
                self.pose = self.loops.anchor.pose(T_anchor_base)
                self.covariance = self.loops.keyframes.frames[anchor].covariance

    def path_m(self):
        return path_m(self.loops, self.pose)

    def from_anchor(self):
        return self.loops.anchor.relative(self.pose)

    def errors(self, poses=None):
        """Distances (N,) of keyframes from their true positions, m."""
        frames = self.loops.keyframes.frames
        truths = np.array([self.truths[frame.scan.stamp_ns] for frame in frames])
        poses = self.loops.keyframes.poses() if poses is None else poses
        return np.hypot(*(poses[: len(truths)] - truths)[:, :2].T)


@pytest.fixture(scope='module')
def ring():
    driver = Driver(bias=DRIFT)
    for truth in round_the_block():
        driver.go(truth, works=4)
    return driver


def test_a_ring_is_closed(ring):
    assert ring.corrections
    assert ring.largest > 1.0, 'without drift there is nothing to close'
    assert ring.errors().max() < 0.6 * ring.largest
    assert np.hypot(*(ring.pose - ring.truths[-1])[:2]) < 0.4
    after = ring.loops.finish()
    assert ring.errors(after).max() < 0.6 * ring.largest
    np.testing.assert_array_equal(after[0], ring.loops.keyframes.poses()[0])


def test_a_correction_contains_old_and_new_keyframe_poses(ring):
    first = ring.corrections[0]
    assert first.before.shape == first.after.shape
    np.testing.assert_array_equal(first.before[0], first.after[0])
    moved = np.hypot(*(first.after - first.before)[:, :2].T)
    assert moved.max() > 0.3
    # The correction grows along the path, without jumps.
    assert np.abs(np.diff(moved)).max() < 0.2


def test_a_closed_loop_leaves_less_uncertainty(ring):
    open_ring = Driver(bias=DRIFT)
    for truth in round_the_block():
        open_ring.go(truth, works=0)
    before = np.trace(open_ring.covariance[:2, :2])
    assert np.trace(ring.covariance[:2, :2]) < 0.5 * before


def test_a_closed_ring_reuses_its_keyframes(ring):
    """On the second lap keyframes of the first side are reused once they match."""
    number = len(ring.loops.keyframes)
    stamps, poses = ring.loops.keyframes.path()
    assert len(stamps) > number
    truths = np.array([ring.truths[stamp] for stamp in stamps])
    assert np.hypot(*(poses - truths)[-5:, :2].T).max() < 0.4


def test_a_drive_that_ends_before_its_matches_are_done_is_closed_all_the_same():
    driver = Driver(bias=DRIFT)
    for truth in round_the_block():
        driver.go(truth, works=0)
    assert driver.errors(driver.loops.finish()).max() < 0.6 * driver.largest
    assert not driver.loops.is_busy


def test_a_little_drift_is_not_made_worse():
    driver = Driver()
    for truth in round_the_block():
        driver.go(truth, works=4)
    assert driver.errors(driver.loops.finish()).max() < driver.largest


def test_where_an_earlier_visit_saw_other_walls_nothing_is_closed():
    """In another building no match is accepted, and no edge is added."""
    driver = Driver(bias=DRIFT)
    way = list(round_the_block())
    for k, truth in enumerate(way):
        if k == 100:
            driver.walls = np.vstack([ROOM + [x, y, x, y] for x, y in OTHER_ROOMS])
        driver.go(truth, works=4)
    assert not driver.corrections
    assert not driver.loops.graph.edges


WIDE = np.diag([9.0, 9.0, 1e-4])


def test_a_loop_that_is_5_m_open_is_closed_in_its_place(monkeypatch):
    """Scans in the smooth hall fit beside it, too: it is closed by views that are apart."""
    driver = Driver(seed=0)
    for k, truth in enumerate(round_the_block(laps=2)):
        if k == 60:
            driver.pose = driver.pose + [5.0, 0.0, 0.0]
            driver.covariance = driver.covariance + WIDE
        with monkeypatch.context() as there:
            there.setattr(f'{__name__}.STEP', STEP + WIDE if k == 60 else STEP)
            driver.go(truth, works=4)
    assert driver.largest > 4.5
    assert driver.errors().max() < 1.0
    assert np.hypot(*(driver.pose - truth)[:2]) < 0.5


def test_the_wall_of_a_hall_is_not_that_of_the_corridor_beside_it(monkeypatch):
    """Scans in the hall fit the far wall of the corridor, 3.3 m off, and see through the others.

    The hall is so deep that the laser does not see its other walls.
    """
    ends = [[0.0, 0.0, 0.0, 3.0], [40.0, 0.0, 40.0, 3.0]]
    corridor = [[0.0, 0.0, 40.0, 0.0], [0.0, 3.0, 40.0, 3.0], *ends]
    driver = Driver(walls=np.array([*corridor, [-20.0, -0.3, 60.0, -0.3]]), seed=2)
    along = [5.0 + 0.6 * k for k in range(50)]
    for x in along:
        driver.go(se2.pose(x, 1.5, 0.0), works=2)
    with monkeypatch.context() as there:
        there.setattr(f'{__name__}.STEP', STEP + WIDE)
        driver.go(se2.pose(along[0], -3.0, 0.0))
    driver.pose = driver.pose + [0.0, 2.0, 0.0]  # as far as the odometry may have drifted
    matches = []
    monkeypatch.setattr(driver.loops.pieces, 'add_match', matches.append)
    for x in along[1:]:
        driver.go(se2.pose(x, -3.0, 0.0), works=2)
    assert len(matches) < driver.loops.min_consistent_matches


def edge_to(loops, a, b, off, sigma=0.03):
    """Edge between keyframes a and b, at an offset (3,) from their current relative pose."""
    frames = loops.keyframes.frames
    T = se2.between(frames[a].T_map_base, frames[b].T_map_base) + off
    return Edge(a, b, T, np.eye(3) / sigma**2, True)


@pytest.fixture
def straight():
    """Twelve keyframes along a hall and twelve back beside them; without any match."""
    loops = loop_closure()
    poses = [se2.pose(k, 0.0, 0.0) for k in range(12)]
    poses += [se2.pose(11 - k, 1.0, np.pi) for k in range(12)]
    for k, pose in enumerate(poses):
        scan = scan_in(ROOM, pose, stamp_ns=k)
        frame = Keyframe(scan, surface_points(scan), pose, float(k), NONE, 0)
        loops.keyframes.add(frame, Step(STEP))
    return loops


def same_correction(loops, number):
    """Candidates that all request to move the return path half a metre to the north."""
    edges = []
    for k in range(number):
        a = k
        b = 22 - k
        frames = loops.keyframes.frames
        moved = frames[b].T_map_base + [0.0, 0.5, 0.0]
        T = se2.between(frames[a].T_map_base, moved)
        edges.append(Edge(a, b, T, np.eye(3) / 0.03**2, True))
    return edges


def test_matches_that_ask_for_the_same_are_consistent(straight):
    edges = same_correction(straight, 5)
    found = largest_consistent(edges, straight.keyframes.frames)
    assert set(map(id, found)) == set(map(id, edges))


def test_a_false_match_is_left_out_of_consistent_ones(straight):
    edges = same_correction(straight, 5)
    false = edge_to(straight, 3, 16, [3.0, -1.0, 0.4])
    found = largest_consistent([edges[0], false, *edges[1:]], straight.keyframes.frames)
    assert set(map(id, found)) == set(map(id, edges))


@pytest.mark.parametrize(
    ('matches', 'inlier_ratio', 'least', 'closes'),
    [(4, 0.95, 5, True), (4, 0.9, 5, False), (4, 0.9, 4, True), (5, 0.9, 8, False)],
)
def test_matches_that_fit_better_close_a_loop_in_smaller_number(
    straight, matches, inlier_ratio, least, closes
):
    straight.adjust(LoopClosureConfig(min_consistent_matches=least), MatchingConfig())
    edges = same_correction(straight, matches)
    straight._requested.extend(replace(edge, inlier_ratio=inlier_ratio) for edge in edges)
    assert len(straight._closing_edges()) == matches * closes


def test_a_single_match_begins_no_optimization_after_a_contradicted_step(rng):
    """The step is measured again at once, off the pose; one match that agrees is no loop."""
    loops = loop_closure()
    truths = np.array([[1.2, 2.0, 0.3], [2.0, 2.0, 0.3], [2.8, 2.0, 0.3]])
    told = truths + [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.3, 0.2, 0.4]]
    for k, jump in enumerate([NONE, NONE, np.diag([0.1, 0.1, 0.05])]):
        scan = scan_in(ROOM[:4] / 2.0, truths[k], rng, k, beams=361)
        frame = Keyframe(scan, surface_points(scan), told[k], float(k), STEP + jump, 0)
        loops.add(frame, Step(STEP), jump)
    (edge,) = loops.graph.edges
    assert loops._mahalanobis(edge) > module.CHI2
    loops._confirm(edge_to(loops, 0, 2, np.zeros(3)))
    assert not loops.graph.is_moving


def test_matches_that_contradict_each_other_close_nothing(straight, rng):
    for k in range(8):
        off = np.array([3.0 * np.cos(2.0 * k), 3.0 * np.sin(2.0 * k), 0.3 * k])
        straight._requested.append(edge_to(straight, k, 22 - k, off))
    assert len(largest_consistent(straight._requested, straight.keyframes.frames)) == 1
    assert straight.step() is None
    assert not straight.graph.is_moving
    assert not straight.graph.edges


def test_matches_of_one_keyframe_do_not_confirm_each_other(straight):
    one = same_correction(straight, 1)[0]
    straight._requested.extend([one, replace(one)])
    assert len(largest_consistent(straight._requested, straight.keyframes.frames)) == 1


def test_a_step_does_one_match_or_one_round(monkeypatch):
    """The number of pending matches does not matter."""
    driver = Driver(bias=DRIFT)
    counts = {'matches': 0, 'rounds': 0}
    match = LoopClosure._match
    rounds = keyframe_graph.rounds

    def counted_match(self, job):
        counts['matches'] += 1
        match(self, job)

    def counted_rounds(poses, edges):
        for each in rounds(poses, edges):
            counts['rounds'] += 1
            yield each

    monkeypatch.setattr(LoopClosure, '_match', counted_match)
    monkeypatch.setattr(keyframe_graph, 'rounds', counted_rounds)
    for truth in round_the_block():
        driver.go(truth, works=0)
        for _ in range(4):
            before = sum(counts.values())
            T_anchor_base = driver.from_anchor()
            correction = driver.loops.step()
            assert sum(counts.values()) - before <= 1
            if correction is not None:
                driver.corrections.append(correction)
                driver.pose = driver.loops.anchor.pose(T_anchor_base)
    assert driver.corrections
    assert counts['rounds'] > 1
    # All pending work is done after enough steps.
    for _ in range(100):
        driver.loops.step()
    before = dict(counts)
    assert driver.loops.step() is None
    assert counts == before


def test_a_keyframe_is_matched_soon_though_each_scan_is_one(monkeypatch):
    """One scan a metre: a match a scan, and up to three to be done."""
    driver = Driver(bias=DRIFT)
    ages = []
    match = LoopClosure._match

    def timed_match(self, job):
        ages.append(len(driver.truths) - 1 - self._frame(job.k).scan.stamp_ns)
        match(self, job)

    monkeypatch.setattr(LoopClosure, '_match', timed_match)
    for truth in round_the_block(step_m=1.0, laps=3):
        driver.go(truth)
    assert len(ages) > 100
    assert max(ages) <= 20
    assert driver.corrections
    assert driver.errors().max() < 0.6 * driver.largest


def test_a_robot_that_stands_about_keeps_one_scan(rng):
    loops = loop_closure()
    kept = 0
    for k in range(50):
        pose = np.array([2.0, 2.0, 0.0]) + rng.normal(0.0, 0.1, 3)
        if loops.needs_keyframe(loops.anchor.relative(pose)):
            scan = scan_in(ROOM, pose, rng, k)
            loops.add(Keyframe(scan, surface_points(scan), pose, 0.0, NONE, 0), Step(STEP), NONE)
            kept += 1
        loops.step()
    assert kept == 1
    assert loops.finish().shape == (1, 3)


def test_the_path_is_measured_in_straight_lines():
    loops = loop_closure()
    assert path_m(loops, np.array([5.0, 5.0, 0.0])) == 0.0
    for k, x in enumerate((0.0, 1.0, 2.0)):
        pose = se2.pose(2.0 + x, 2.0, 0.0)
        scan = scan_in(ROOM, pose, stamp_ns=k)
        frame = Keyframe(scan, surface_points(scan), pose, path_m(loops, pose), NONE, 0)
        loops.add(frame, Step(STEP), NONE)
    assert path_m(loops, np.array([4.0, 5.0, 0.0])) == pytest.approx(5.0)


def test_a_step_with_a_jump_is_measured_again(rng):
    """Scan and motion contradicted each other on a step; earlier keyframes have the same view."""
    loops = loop_closure()
    truths = np.array([[1.2, 2.0, 0.3], [2.0, 2.0, 0.3], [2.8, 2.0, 0.3]])
    told = truths + [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.3, 0.2, 0.05]]
    for k, jump in enumerate([NONE, NONE, np.diag([0.1, 0.1, 0.01])]):
        scan = scan_in(ROOM[:4] / 2.0, truths[k], rng, k, beams=361)
        points = surface_points(scan)
        loops.add(Keyframe(scan, points, told[k], float(k), STEP + jump, 0), Step(STEP), jump)
        loops.step()
    assert [(edge.a, edge.b) for edge in loops.graph.edges] == [(1, 2)]
    T = se2.between(truths[1], truths[2])
    np.testing.assert_allclose(loops.graph.edges[0].T_a_b, T, atol=0.05)
    assert np.hypot(*(loops.finish()[2] - truths[2])[:2]) < 0.1


@pytest.mark.parametrize(('off', 'measured'), [((0.6, 0.0), True), ((0.0, 0.6), False)])
def test_what_has_jumped_is_as_uncertain_as_step_and_jump_together(off, measured):
    loops = loop_closure()
    jump = np.diag([0.09, 0.01, 0.02])
    for k, uncertain in enumerate([NONE, jump]):
        truth = se2.pose(2.0, 2.0 + k, 0.5 * np.pi)
        told = se2.compose(truth, k * np.array([*off, 0.0]))
        scan = scan_in(ROOM, truth, stamp_ns=k)
        points = surface_points(scan)
        loops.add(Keyframe(scan, points, told, float(k), NONE, 0), Step(STEP), uncertain)
    loops.finish()
    # In the frame of the anchor: along the robot's way is x.
    np.testing.assert_allclose(inverse(loops.keyframes.steps[0].information), STEP + jump)
    assert bool(loops.graph.edges) == measured


def test_the_step_covariance_is_that_of_the_step(rng):
    loops = loop_closure()
    for k, pose in enumerate([np.zeros(3), np.array([1.0, 0.0, 0.2])]):
        scan = scan_in(ROOM, pose + [2.0, 2.0, 0.0], rng, k)
        loops.add(Keyframe(scan, surface_points(scan), pose, float(k), NONE, 0), Step(STEP), NONE)
    loops.finish()
    np.testing.assert_allclose(inverse(loops.keyframes.steps[0].information), STEP)


def test_an_edge_to_what_is_seen_again_holds_the_errors_of_step_and_match(rng):
    """Edge from the anchor to an earlier keyframe through a scan that both match; by sampling."""
    loops = loop_closure()
    poses = [se2.pose(2.0, 2.0, 0.3), se2.pose(4.0, 2.0, 2.0), se2.pose(2.3, 2.5, 0.8)]
    frames = []
    for k, pose in enumerate(poses):
        scan = scan_in(ROOM, pose, stamp_ns=k)
        frames.append(Keyframe(scan, surface_points(scan), pose, 10.0 * k, NONE, 0))
    for frame in frames[:2]:
        loops.keyframes.add(frame, Step(STEP))
    by_match = np.diag(np.square([0.02, 0.01, 0.05]))
    by_step = np.diag([4e-4, 1e-4, 4e-4])
    loops._pending = module._Pending(frames[2], Step(by_step), se2.between(poses[1], poses[2]))
    T_j_here = se2.between(poses[0], poses[2])
    T_a_here = se2.between(poses[1], poses[2])
    loops._confirm(Edge(0, 2, T_j_here, inverse(by_match), True))
    edge = loops.graph.edges[0]
    assert (edge.a, edge.b) == (1, 0)
    assert loops.keyframes.anchor == 0
    np.testing.assert_allclose(edge.T_a_b, se2.between(poses[1], poses[0]), atol=1e-12)
    sampled = np.array(
        [
            se2.compose(T_a_here + step, se2.invert(T_j_here + match))
            for step, match in zip(
                rng.multivariate_normal(np.zeros(3), by_step, 20000),
                rng.multivariate_normal(np.zeros(3), by_match, 20000),
                strict=True,
            )
        ]
    )
    truth = np.cov(sampled, rowvar=False)
    scale = np.sqrt(np.outer(np.diag(truth), np.diag(truth)))
    np.testing.assert_allclose(inverse(edge.information) / scale, truth / scale, atol=0.06)
