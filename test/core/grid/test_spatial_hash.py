"""Numbers indexed by position."""

import math

import numpy as np

from thinmap_ros.core.grid.fields import SpatialHash


def test_all_that_is_near_is_found_and_little_else():
    rng = np.random.default_rng(0)
    places = rng.uniform(-50.0, 50.0, (500, 2))
    buckets = SpatialHash(4.0)
    for number, (x, y) in enumerate(places.tolist()):
        buckets.insert(number, x, y)
    for x, y in rng.uniform(-60.0, 60.0, (50, 2)).tolist():
        found = buckets.query_radius(x, y, 7.0)
        away = np.abs(places - (x, y)).max(axis=1)
        assert set(np.flatnonzero(away <= 7.0).tolist()) <= set(found)
        assert (away[found] <= 7.0 + 4.0).all()
        assert found == sorted(set(found))


def test_what_moves_is_found_where_it_is_now():
    buckets = SpatialHash(1.0)
    buckets.insert(3, 0.5, 0.5)
    buckets.insert(3, 10.5, 0.5)
    assert buckets.query_radius(0.5, 0.5, 1.0) == [] and buckets.query_radius(10.0, 0.0, 1.0) == [3]
    buckets.remove(3)
    buckets.remove(3)
    assert buckets.query_radius(10.0, 0.0, 1.0) == []


def test_a_place_that_is_not_finite_is_near_to_nothing():
    buckets = SpatialHash(1.0)
    buckets.insert(1, 0.5, 0.5)
    buckets.insert(1, math.nan, 0.5)
    buckets.insert(2, math.inf, 0.5)
    assert buckets.query_radius(0.5, 0.5, 3.0) == []
    assert buckets.query_radius(math.nan, 0.5, 3.0) == []
