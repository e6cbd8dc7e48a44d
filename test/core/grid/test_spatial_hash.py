"""Numbers found by place."""

import math

import numpy as np

from thinmap_ros.core.grid.spatial_hash import SpatialHash


def test_all_that_is_near_is_found_and_little_else():
    rng = np.random.default_rng(0)
    places = rng.uniform(-50.0, 50.0, (500, 2))
    buckets = SpatialHash(4.0)
    for number, (x, y) in enumerate(places.tolist()):
        buckets.put(number, x, y)
    for x, y in rng.uniform(-60.0, 60.0, (50, 2)).tolist():
        found = buckets.near(x, y, 7.0)
        away = np.abs(places - (x, y)).max(axis=1)
        assert set(np.flatnonzero(away <= 7.0).tolist()) <= set(found)
        assert (away[found] <= 7.0 + 4.0).all()
        assert found == sorted(set(found))


def test_what_moves_is_found_where_it_is_now():
    buckets = SpatialHash(1.0)
    buckets.put(3, 0.5, 0.5)
    buckets.put(3, 10.5, 0.5)
    assert buckets.near(0.5, 0.5, 1.0) == [] and buckets.near(10.0, 0.0, 1.0) == [3]
    buckets.drop(3)
    buckets.drop(3)
    assert buckets.near(10.0, 0.0, 1.0) == []


def test_a_place_that_is_not_finite_is_near_to_nothing():
    buckets = SpatialHash(1.0)
    buckets.put(1, 0.5, 0.5)
    buckets.put(1, math.nan, 0.5)
    buckets.put(2, math.inf, 0.5)
    assert buckets.near(0.5, 0.5, 3.0) == []
    assert buckets.near(math.nan, 0.5, 3.0) == []
