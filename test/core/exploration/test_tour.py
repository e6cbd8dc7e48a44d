"""Tours compared with all permutations, and deferred targets."""

import itertools

import numpy as np
import pytest

from thinmap_ros.core.exploration.tour import tours_by_first


def cost(order, from_start, between, weight, most):
    along = [from_start[order[0]]]
    for a, b in itertools.pairwise(order):
        along.append(along[-1] + between[a, b])
    return along[-1] + weight * sum(min(way, most) for way in along)


def between_of(points):
    return np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))


@pytest.mark.parametrize('weight', [0.0, 0.2])
@pytest.mark.parametrize('count', [1, 2, 3, 4, 6])
def test_tours_are_as_good_as_the_best_of_all_orders_or_nearly(count, weight):
    rng = np.random.default_rng(count)
    for _ in range(10):
        points = 20.0 * rng.random((count, 2))
        ways = np.hypot(*points.T)
        between = between_of(points)
        found = tours_by_first(ways, between, np.full(count, weight), 10.0)
        for first in range(count):
            orders = [order for order in itertools.permutations(range(count)) if order[0] == first]
            best = min(cost(order, ways, between, weight, 10.0) for order in orders)
            assert best - 1e-9 <= found[first] <= 1.1 * best


def test_a_place_that_would_have_to_be_come_back_to_comes_first():
    # A niche 3 m to one side, and three rooms in a row from 2 m on to the other: the nearest first
    # would cost 6 m more.
    points = np.array([[-3.0, 0.0], [2.0, 0.0], [12.0, 0.0], [22.0, 0.0]])
    costs = tours_by_first(np.abs(points[:, 0]), between_of(points), np.zeros(4), 0.0)
    assert int(costs.argmin()) == 0
    assert costs[0] == pytest.approx(28.0)


def test_waiting_makes_near_places_come_first():
    # A tour to a distant place and back past a near one is as long as its reverse.
    points = np.array([[1.0, 0.0], [10.0, 0.0], [-8.0, 0.0]])
    between = between_of(points)
    ways = np.abs(points[:, 0])
    assert int(tours_by_first(ways, between, np.zeros(3), 0.0).argmin()) == 2
    assert int(tours_by_first(ways, between, np.ones(3), 30.0).argmin()) == 0
