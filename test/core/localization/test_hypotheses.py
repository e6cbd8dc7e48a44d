"""Places where the robot may be: evidence, samples of their own, and what becomes of doubles."""

import numpy as np
import pytest

from thinmap_ros.core.localization.hypotheses import Hypotheses, evidence_against
from thinmap_ros.core.localization.search import SILENT_COUNTS


def some(*poses, log_weights=None):
    poses = np.array(poses, dtype=np.float64)
    known = Hypotheses.none()
    logs = np.zeros(len(poses)) if log_weights is None else np.array(log_weights, dtype=np.float64)
    known.add(poses, logs, (np.full(len(poses), 50.0), np.zeros(len(poses))), 60.0)
    known.resample(None, 1000, np.random.default_rng(0))
    return known


def test_what_chance_brings_about_at_edges_counts_for_nothing():
    counts = np.array([58.0, 55.0, 54.0, 20.0])
    against = evidence_against((counts, np.zeros(4)), 60, 1.0)
    assert not against[:3].any()
    assert against[3] > 1.0
    assert evidence_against((counts, np.zeros(4)), 60, 0.1) == pytest.approx(0.1 * against)


def test_a_beam_of_which_the_map_says_nothing_counts_for_a_part():
    silent = evidence_against((np.array([60.0, 20.0]), np.array([0.0, 40.0])), 60, 1.0)[1]
    denied = evidence_against((np.array([60.0, 20.0 + SILENT_COUNTS * 40.0]), np.zeros(2)), 60, 1.0)[1]
    assert silent == pytest.approx(denied)
    assert evidence_against((np.array([60.0, 20.0]), np.zeros(2)), 60, 1.0)[1] > silent > 0.0


def test_each_hypothesis_keeps_samples_of_its_own_however_unlikely():
    known = some([0, 0, 0], [5, 0, 1], [0, 5, 2], log_weights=[0.0, -9.0, -3.0])
    logs = np.where(known.owners == 1, -1000.0, 0.0)
    known.resample(logs, 1000, np.random.default_rng(1))
    assert np.bincount(known.owners).tolist() == [334, 333, 333]
    for k in range(3):
        own = known.samples[known.owners == k]
        assert np.hypot(*(own[:, :2] - known.poses[k, :2]).T).max() < 1.0


def test_covariance_is_that_of_the_weighted_samples():
    known = some([1, 2, 3.1])
    logs = np.random.default_rng(3).normal(size=len(known.samples))
    known.weigh(logs)
    turned = known.samples - known.poses[0]
    assert known.covariances[0] == pytest.approx(np.cov(turned.T, aweights=np.exp(logs), bias=True), abs=1e-9)


def test_doubles_become_one_and_the_hopeless_are_dropped():
    known = some([0, 0, 0], [0.05, 0, 0.02], [9, 0, 0], [3, 3, 0], log_weights=[-1.0, 0.0, -20.0, -2.0])
    known.prune()
    assert known.poses[:, 0].tolist() == [0.05, 3.0]
    assert known.weights.sum() == pytest.approx(1.0)
    assert np.unique(known.owners).tolist() == [0, 1]
    assert len(known.samples) == len(known.owners) == 500


def test_odometry_moves_hypotheses_and_samples_alike():
    known = some([1, 1, np.pi / 2])
    mean = known.samples.mean(axis=0)
    known.move(np.array([1.0, 0.0, 0.1]), (0.0, 0.0), np.random.default_rng(0))
    assert known.poses[0] == pytest.approx([1.0, 2.0, np.pi / 2 + 0.1])
    assert known.samples.mean(axis=0) == pytest.approx(mean + [0.0, 1.0, 0.1], abs=0.02)
