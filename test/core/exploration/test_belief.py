"""Belief: probability that nothing is hidden, and the area that is missing."""

import numpy as np
import pytest

from thinmap_ros.core.exploration.belief import Hidden, fringe_m2, missing_area
from thinmap_ros.core.exploration.fitted import FITTED


def probability(length_m=1.0, hidden_m2=1.0, depth_m=1.0, visits=0):
    return FITTED.probability(length_m, hidden_m2, depth_m, visits)


def test_the_frontier_is_the_prior():
    assert probability(length_m=0.5) > probability(length_m=1.0) > probability(length_m=3.0)
    assert probability(hidden_m2=0.1) > probability(hidden_m2=2.0) > probability(hidden_m2=20.0)


def test_inside_of_a_wall_nothing_is_hidden():
    assert probability(depth_m=0.2) > probability(depth_m=0.5) > probability(depth_m=1.0)
    assert probability(hidden_m2=0.5, depth_m=0.2) > 0.95


def test_visits_speak_for_nothing():
    assert probability(visits=2) > probability(visits=1) > probability()


def test_probabilities_are_never_certain():
    assert probability(length_m=1e6, hidden_m2=1e6) > 0.0
    assert probability(length_m=1e-9, hidden_m2=0.0, depth_m=0.0, visits=10**6) < 1.0


def test_more_in_line_of_sight_means_more_behind():
    areas = [FITTED.mean_area(hidden) for hidden in (0.0, 6.0, 12.0, 18.0, 22.0, 30.0)]
    assert areas[0] < areas[-1]
    assert min(areas) > 0.0


def test_the_missing_area_is_the_sum_of_what_is_expected():
    hidden = [Hidden(0.9, 0.0, 10.0), Hidden(0.2, 0.1, 5.0), Hidden(0.5, 0.2, 2.0)]
    missing = missing_area(hidden)
    assert missing.expected_m2 == pytest.approx(1.0 + 4.02 + 1.1)
    assert missing.bound_m2 > missing.expected_m2
    assert missing_area([]) == (0.0, 0.0)
    assert missing_area([Hidden(1.0, 0.0, 5.0)]) == (0.0, 0.0)


def test_nineteen_of_twenty_times_no_more_is_missing_than_the_bound():
    hidden = [Hidden(0.8, 0.5, 4.0)] * 30
    rng = np.random.default_rng(3)
    is_worth_seeing = rng.random((2000, 30)) >= 0.8
    missing = rng.exponential(np.where(is_worth_seeing, 4.0, 0.5)).sum(axis=1)
    share = np.mean(missing <= missing_area(hidden).bound_m2)
    assert 0.9 < share < 0.98


def test_a_fringe_is_as_long_as_its_frontier_and_as_deep_as_a_part_of_a_cell():
    assert fringe_m2(2.0, 0.1) == pytest.approx(4.0 * fringe_m2(1.0, 0.05))
