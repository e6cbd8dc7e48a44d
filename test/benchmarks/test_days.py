"""Days of the benchmark: other furniture each day, and never at the start."""

import numpy as np

from benchmarks.buildings import BuildingConfig, generate_building
from benchmarks.days import furnished
from thinmap_ros.sim.drives import random_start


def test_furniture_moves_each_night_and_leaves_the_start_free():
    world = generate_building(9, BuildingConfig(area_m2=350.0, people_per_1000_m2=0.0)).world
    start = random_start(world, np.random.default_rng(1))
    floors = [furnished(world, start, day) for day in (0, 1, 1)]
    added = [np.count_nonzero(each.occupied) - np.count_nonzero(world.occupied) for each in floors]
    area_m2 = np.array(added) * world.frame.resolution**2
    assert (area_m2 > 3.0).all(), 'some boxes'
    assert not np.array_equal(floors[0].occupied, floors[1].occupied)
    np.testing.assert_array_equal(floors[1].occupied, floors[2].occupied)
    assert all(each.is_clear(*start[:2], 0.5) for each in floors) == world.is_clear(*start[:2], 0.5)
