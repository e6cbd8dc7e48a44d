"""Constellations of landmarks: poses that pairs determine, and the time that they take."""

import numpy as np
import pytest
from support.driven_pieces import driven_piece

from thinmap_ros.core import se2
from thinmap_ros.core.places import piece as constellation_kernels
from thinmap_ros.core.places.piece import (
    SAME_M,
    SAME_RAD,
    ConstellationIndex,
    Landmarks,
    landmarks_around,
    landmarks_of,
)
from thinmap_ros.core.topology.graph import NodeKind


def scattered(rng, count, side_m):
    return Landmarks(rng.uniform(0.0, side_m, (count, 2)), rng.uniform(0.3, 3.0, count))


def seen_from(landmarks, T, rng, near_m=9.0):
    """Landmarks around a pose, in its frame, with the errors of another visit."""
    near = np.hypot(*(landmarks.xy - T[:2]).T) < near_m
    xy = se2.transform_points(se2.invert(T), landmarks.xy[near])
    noise = rng.normal(0.0, 0.05, xy.shape)
    return Landmarks(xy + noise, landmarks.clearances[near] + rng.normal(0.0, 0.03, near.sum()))


@pytest.mark.parametrize('number', range(8))
def test_the_true_pose_is_among_the_candidates(number):
    rng = np.random.default_rng(number)
    landmarks = scattered(rng, 80, 40.0)
    index = ConstellationIndex(landmarks)
    T = np.array([20.0, 20.0, 0.0]) + rng.uniform(-1.0, 1.0, 3) * (8.0, 8.0, 3.0)
    found = index.candidates(seen_from(landmarks, T, rng))
    off = np.array([se2.between(T, candidate) for candidate in found])
    is_near = (np.hypot(off[:, 0], off[:, 1]) < 0.6) & (np.abs(off[:, 2]) < 0.1)
    assert is_near.any()
    assert len(found) <= 60


def test_candidates_differ(rng):
    landmarks = scattered(rng, 60, 30.0)
    found = ConstellationIndex(landmarks).candidates(seen_from(landmarks, np.zeros(3), rng, 30.0))
    for k, T in enumerate(found):
        off = np.abs(found[:k] - T)
        assert not ((off[:, :2] < SAME_M).all(axis=1) & (off[:, 2] < SAME_RAD)).any()


def test_few_landmarks_make_no_candidates(rng):
    landmarks = scattered(rng, 30, 20.0)
    none = Landmarks(np.empty((0, 2)), np.empty(0))
    one = Landmarks(np.ones((1, 2)), np.ones(1))
    for few in (none, one):
        assert ConstellationIndex(landmarks).candidates(few).shape == (0, 3)
        assert ConstellationIndex(few).candidates(landmarks).shape == (0, 3)


def test_the_rarest_pairs_are_compared_first_and_not_too_many():
    """A lattice, where all pairs are alike, and one that occurs once."""
    x, y = np.meshgrid(np.arange(40.0) * 2.0, np.arange(40.0) * 2.0)
    xy = np.vstack([np.column_stack([x.ravel(), y.ravel()]), [[41.0, 41.0], [41.0, 49.37]]])
    clearances = np.append(np.ones(1600), [2.5, 3.3])
    keys, first, second = constellation_kernels.pairs_of(xy, clearances)
    order = np.argsort(keys, kind='stable')
    own = np.vstack([xy[800:830], [[0.0, 0.0], [8.37, 0.0]]])
    poses, weights = constellation_kernels.poses_by_pairs(
        own, np.append(np.ones(30), [2.5, 3.3]), xy, keys[order], first[order], second[order]
    )
    assert len(poses) == constellation_kernels._MAX_POSES
    assert np.all(np.diff(weights) <= 0.0)
    np.testing.assert_allclose(poses[0], [41.0, 41.0, np.pi / 2.0], atol=0.1)


def test_landmarks_are_the_branch_nodes():
    piece = driven_piece(1, 1).piece
    branches = [node for node in piece.graph.nodes.values() if node.kind is NodeKind.BRANCH]
    found = landmarks_of(piece.graph)
    assert len(found) == len(branches) > 5
    np.testing.assert_array_equal(found.xy, [node.position for node in branches])


def test_landmarks_around_a_view_are_those_of_the_whole_map():
    piece = driven_piece(1, 1).piece
    for view in piece.views:
        near = landmarks_around(piece.graph, view)
        whole = landmarks_of(piece.graph).around(view)
        assert len(near) == len(whole)
        assert {tuple(p) for p in np.round(near.xy, 6)} == {tuple(p) for p in np.round(whole.xy, 6)}
