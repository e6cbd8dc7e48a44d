"""Budgets, and the distance that is counted against them."""

import numpy as np
import pytest

from thinmap_ros.core.exploration.session import Budget, Odometer


def test_noise_at_a_standstill_is_no_distance_but_a_slow_robot_gets_on():
    odometer = Odometer()
    rng = np.random.default_rng(1)
    for _ in range(500):
        odometer.add(np.append(rng.normal(0.0, 0.002, 2), 0.0))
    assert odometer.distance_m == 0.0
    for x in np.arange(0.0, 2.0, 0.005):
        odometer.add(np.array([x, 0.0, 0.0]))
    assert odometer.distance_m == pytest.approx(2.0, abs=0.05)


def test_the_start_is_the_first_pose():
    odometer = Odometer()
    assert odometer.start is None
    odometer.add(np.array([1.0, 2.0, 0.5]))
    odometer.add(np.array([2.0, 2.0, 0.5]))
    assert odometer.start is not None
    assert odometer.start.tolist() == [1.0, 2.0, 0.5]


@pytest.mark.parametrize(
    ('used', 'word'),
    [
        ((9.0, 4.0, 19.0), ''),
        ((10.0, 0.0, 0.0), 'time'),
        ((0.0, 5.0, 0.0), 'distance'),
        ((0.0, 0.0, 21.0), 'area'),
    ],
)
def test_each_limit_ends_it_and_says_which(used, word):
    reason = Budget(10.0, 5.0, 20.0).used_up(*used)
    assert (reason == '') if not word else reason.startswith(word)


def test_without_limits_nothing_is_ever_used_up():
    assert Budget().used_up(1e9, 1e9, 1e9) == ''
