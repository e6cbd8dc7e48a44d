"""Pose hypotheses: evidence, their samples, and merging of duplicates."""

import numpy as np
import pytest

from thinmap_ros.core.places.hypotheses import Hypotheses, Look, allowed_beams, missed_beams
from thinmap_ros.core.places.likelihood import LOG_ODDS_A_BEAM, SILENT_COUNTS
from thinmap_ros.core.places.place_odds import MAX_LOG_RATIO

MOST = 20.0


def look_of(counts, beams=60, log_ratio=1.0):
    """A look at which each place explains so many beams."""
    counts = np.array(counts)
    missed = missed_beams((counts, np.zeros(len(counts))), beams)
    return Look(missed, beams, counts / beams, np.full(len(counts), log_ratio))


def some(*poses, log_weights=None):
    poses = np.array(poses, dtype=np.float64)
    known = Hypotheses.none()
    logs = np.zeros(len(poses)) if log_weights is None else np.array(log_weights, dtype=np.float64)
    missed = np.where(
        logs < 0.0, allowed_beams(np.full(len(poses), 60.0)) - logs / LOG_ODDS_A_BEAM, 0.0
    )
    every = np.ones(len(poses))
    known.add(poses, 0.0, [Look(missed, 60, every, every)], MOST)
    known.resample(None, 1000, np.random.default_rng(0))
    return known


def looked(known, *looks, novelty=1.0):
    for counts in looks:
        known.take_evidence(look_of(counts), novelty, MOST)
    return known


def test_random_misses_at_edges_are_no_evidence():
    rng = np.random.default_rng(2)
    three = some([0, 0, 0], [5, 0, 1], [0, 5, 2])
    known = looked(three, *([58.0 - rng.binomial(3, 0.3), 57.0, 57.0] for _ in range(50)))
    assert not known.log_weights.any()


def test_what_a_place_misses_at_each_look_adds_up_until_it_is_out_of_the_question():
    seldom, often = [
        looked(some([0, 0, 0], [5, 0, 1]), *([[58.0, 52.0]] * n)).log_weights for n in (1, 12)
    ]
    assert not seldom[1] < -1.0
    assert often.tolist() == [0.0, pytest.approx(often[1])]
    assert often[1] < -5.0


def test_one_look_settles_nothing_and_half_a_look_half_as_much():
    nonsense = looked(some([0, 0, 0], [5, 0, 1]), [58.0, 0.0])
    assert -MAX_LOG_RATIO < nonsense.log_weights[1] < -1.0
    halves = looked(some([0, 0, 0], [5, 0, 1]), [58.0, 0.0], [58.0, 0.0], novelty=0.5)
    assert halves.log_weights == pytest.approx(nonsense.log_weights)


def test_a_place_that_turns_up_late_is_judged_by_what_it_was_asked():
    known = looked(some([0, 0, 0], [5, 0, 1]), *([[50.0, 50.0]] * 40))
    looks = [look_of([50.0, 50.0, 60.0]) for _ in range(6)]
    known.add(np.array([[9.0, 9.0, 0.0]]), -3.0, looks, MOST)
    assert known.best() == 2
    assert known.log_weights[0] == pytest.approx(
        3.0 - LOG_ODDS_A_BEAM * (60.0 - allowed_beams(np.array(360.0)))
    )
    assert known.evidence.tolist() == [MOST, MOST, 6.0 - 3.0]


def test_evidence_that_adds_nothing_is_forgotten_so_that_what_changes_is_noticed():
    known = looked(some([0, 0, 0]), *([[60.0]] * 1000))
    known.take_evidence(look_of([0.0], log_ratio=-MAX_LOG_RATIO), 0.5, MOST)
    assert known.evidence.tolist() == [MOST - 0.5 * MAX_LOG_RATIO]
    assert known.found.tolist() == [0.0]


def test_a_beam_of_which_the_map_says_nothing_counts_for_a_part():
    silent = missed_beams((np.array([60.0, 50.0]), np.array([0.0, 10.0])), 60)[1]
    denied = missed_beams((np.array([60.0, 50.0 + SILENT_COUNTS * 10.0]), np.zeros(2)), 60)[1]
    assert silent == pytest.approx(denied)
    assert missed_beams((np.array([60.0, 50.0]), np.zeros(2)), 60)[1] > silent > 0.0


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
    assert known.covariances[0] == pytest.approx(
        np.cov(turned.T, aweights=np.exp(logs), bias=True), abs=1e-9
    )


def test_doubles_become_one_and_the_hopeless_are_dropped():
    known = some(
        [0, 0, 0], [0.05, 0, 0.02], [9, 0, 0], [3, 3, 0], log_weights=[-1.0, 0.0, -20.0, -2.0]
    )
    known.prune()
    assert known.poses[:, 0].tolist() == [0.05, 3.0]
    assert known.weights.sum() == pytest.approx(1.0)
    assert np.unique(known.owners).tolist() == [0, 1]
    assert len(known.samples) == len(known.owners) == 500


def test_a_place_that_is_found_again_keeps_what_its_own_looks_have_told():
    """Odometry tells the looks of the new one, by which the known ones miss something, too."""
    known = looked(some([0, 0, 0], [5, 0, 1]), *([[60.0, 60.0]] * 30))
    looks = [look_of([50.0, 50.0, 60.0]) for _ in range(6)]
    known.add(np.array([[0.05, 0.0, 0.02]]), -6.0, looks, MOST)
    known.prune()
    assert known.poses[:, 0].tolist() == [0.0, 5.0]
    assert known.evidence.tolist() == [MOST, MOST]
    assert not known.log_weights.any()


def test_odometry_moves_hypotheses_and_samples_alike():
    known = some([1, 1, np.pi / 2])
    mean = known.samples.mean(axis=0)
    known.move(np.array([1.0, 0.0, 0.1]), (0.0, 0.0), np.random.default_rng(0))
    assert known.poses[0] == pytest.approx([1.0, 2.0, np.pi / 2 + 0.1])
    assert known.samples.mean(axis=0) == pytest.approx(mean + [0.0, 1.0, 0.1], abs=0.02)
