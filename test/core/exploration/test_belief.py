"""Belief: probability that nothing is hidden, and the area that is missing."""

import numpy as np
import pytest

from thinmap_ros.core.exploration.belief.evidence import Evidence
from thinmap_ros.core.exploration.belief.fitted import FITTED
from thinmap_ros.core.exploration.belief.model import missing_area


def evidence(views=(), visits=0):
    return Evidence(1, (0.0, 0.0), (0.0, 0.0), list(views), 0.0, visits)


def probability(length_m=1.0, hidden_m2=1.0, **values):
    return FITTED.probability(evidence(**values), length_m, hidden_m2)


def test_the_frontier_is_the_prior():
    assert probability(length_m=0.5) > probability(length_m=1.0) > probability(length_m=3.0)
    assert probability(hidden_m2=0.1) > probability(hidden_m2=2.0) > probability(hidden_m2=20.0)
    assert probability(length_m=0.0, hidden_m2=20.0) > 0.99, 'without a frontier it is settled'


def test_near_views_and_visits_speak_for_nothing():
    seen_far = probability(views=[(8.0, 0.0)])
    assert probability(views=[(1.0, 0.0)]) >= seen_far
    assert probability(visits=1) > probability()


def test_probabilities_are_never_certain():
    assert probability(length_m=1e6, hidden_m2=1e6) > 0.0
    assert probability(length_m=1e-9, hidden_m2=0.0, visits=10**6) < 1.0


def test_more_in_line_of_sight_means_more_behind():
    areas = [FITTED.mean_area(1.0, hidden) for hidden in (0.0, 6.0, 12.0, 18.0, 22.0, 30.0)]
    assert areas[0] < areas[-1]
    assert min(areas) > 0.0


def test_the_missing_area_is_the_sum_of_what_is_expected():
    probabilities = np.array([0.9, 0.2, 0.5])
    areas = np.array([10.0, 5.0, 2.0])
    missing = missing_area(probabilities, areas)
    assert missing.expected_m2 == pytest.approx(1.0 + 4.0 + 1.0)
    assert missing.bound_m2 > missing.expected_m2
    assert missing == missing_area(probabilities, areas), 'the same for the same candidates'
    assert missing_area(np.empty(0), np.empty(0)) == (0.0, 0.0)


def test_nineteen_of_twenty_times_no_more_is_missing_than_the_bound():
    probabilities = np.full(30, 0.8)
    areas = np.full(30, 4.0)
    rng = np.random.default_rng(3)
    hidden = rng.random((2000, 30)) >= probabilities
    missing = np.where(hidden, rng.exponential(areas, hidden.shape), 0.0).sum(axis=1)
    share = np.mean(missing <= missing_area(probabilities, areas).bound_m2)
    assert 0.9 < share < 0.98
