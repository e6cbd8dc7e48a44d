"""Tables of joint maps, of short drives through small generated buildings."""

from pathlib import Path

import numpy as np
import pytest
from support.driven_pieces import world_of

from benchmarks.joining import tables
from benchmarks.worlds import Floor
from thinmap_ros.sim.drives import random_start


def floor(seed):
    world = world_of(seed)
    starts = [random_start(world, np.random.default_rng([seed, k])) for k in range(5)]
    return Floor(f'building_{seed}', Path(), world, np.array(starts))


@pytest.fixture(scope='module')
def floors():
    return [floor(1), floor(3)]


def test_two_buildings_are_not_joined(floors):
    (row,) = tables.foreign(floors, 100.0).rows
    pairs, hours, searches, joins, _ = row
    assert (pairs, joins) == (1, 0)
    assert hours == pytest.approx(100.0 / 3600.0)
    assert searches > 0


def test_the_load_of_five_robots_is_measured(floors):
    rows = tables.load(floors, 60.0).rows
    assert [row[0].partition(',')[0] for row in rows] == ['nothing', 'search', 'merge']
    assert all(row[1] > 0 and row[4] >= row[2] >= 0.0 for row in rows)
