"""Which cells count as free for the robot."""

import numpy as np
import pytest
from drawings import drawn, patch_of
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.fields import label, reachable, squared_distance
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.thinning import (
    beyond_radius,
    known_free,
    select_free_space,
    standing_room,
    without_islands,
)


def random_mask(seed):
    rng = np.random.default_rng(seed)
    return rng.random(rng.integers(1, 40, 2)) < rng.uniform(0.5, 0.99)


def exact_distance(free):
    return ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1]


@given(st.integers(0, 10_000), st.floats(0.0, 6.0))
@settings(max_examples=60)
def test_standing_room_is_all_that_is_far_enough(seed, radius):
    free = random_mask(seed)
    wanted = free & (exact_distance(free) >= radius - 1e-9)
    assert np.array_equal(standing_room(free, radius), wanted)


@pytest.mark.parametrize('resolution', [0.01, 0.02, 0.03, 0.05, 0.1, 0.125, 0.3])
@pytest.mark.parametrize('radius_m', [0.0, 0.2, 0.25, 0.3, 0.35])
def test_nav2_calls_no_cell_beyond_the_radius_inscribed(resolution, radius_m):
    free = np.random.default_rng(7).random((90, 90)) < 0.9995
    config = beyond_radius(TopologyConfig(robot_radius_m=radius_m), resolution)
    standing = standing_room(free, config.robot_radius_m / resolution)
    # As in computeCost() of Nav2's inflation layer.
    inscribed = exact_distance(free) * resolution <= radius_m + 1e-9
    assert np.array_equal(standing, free & ~inscribed)


def test_the_largest_robot_has_no_larger_radius():
    assert beyond_radius(TopologyConfig(robot_radius_m=5.0), 0.05).robot_radius_m == 5.0


@given(st.integers(0, 10_000))
@settings(max_examples=60)
def test_squared_clearance_is_exact(seed):
    free = random_mask(seed)
    squared = squared_distance(~free, is_rim_marked=True)
    assert np.array_equal(squared, np.round(exact_distance(free) ** 2).astype(int))


@given(st.integers(0, 10_000))
@settings(max_examples=40)
def test_parts_as_scipy_labels_them(seed):
    mask = random_mask(seed)
    labels, sizes = label(mask)
    wanted, count = ndimage.label(mask, np.ones((3, 3)))
    assert np.array_equal(labels, wanted)
    assert sizes.tolist()[1:] == [int((wanted == k).sum()) for k in range(1, count + 1)]
    seeds = np.argwhere(mask)[:1]
    part = wanted == wanted[tuple(seeds[0])] if len(seeds) else np.zeros_like(mask)
    assert np.array_equal(reachable(mask, seeds), part & mask)


def test_unknown_specks_between_beams_are_closed_but_no_larger_hole():
    cells = np.zeros((60, 60))
    cells[20, 20] = cells[40:42, 30] = -1
    cells[30:34, 44:48] = -1
    cells[10, 10] = 100
    free = known_free(patch_of(cells), TopologyConfig(max_unknown_gap_m=0.2))
    assert free[20, 20] and free[40:42, 30].all()
    assert not free[31:33, 45:47].any()
    assert not free[10, 10], 'an occupied cell is never noise'


def test_gap_beside_an_obstacle_stays_unknown():
    cells = np.zeros((9, 9))
    cells[:, 4] = 100
    cells[:, 5] = -1
    assert not known_free(patch_of(cells), TopologyConfig()).all(axis=0)[4:6].any()


def test_lone_occupied_cell_keeps_the_robot_away():
    cells = np.zeros((50, 50))
    cells[25, 25] = 100
    free = select_free_space(patch_of(cells), None, TopologyConfig(robot_radius_m=0.3))
    assert not free[25, 22:29].all() and not free[25, 23:28].any()


def test_only_what_the_robot_can_reach():
    patch = drawn('#######', '#..#..#', '#..#..#', '#######')
    both = select_free_space(patch, None, TopologyConfig())
    left = select_free_space(patch, (1.5, 1.5), TopologyConfig())
    assert label(both)[1].size == 3
    assert left.any() and not left[:, 35:].any() and np.array_equal(left[:, :30], both[:, :30])


def test_seed_beside_the_free_space_finds_it_within_reach():
    patch = drawn('####', '#..#', '#..#', '####')
    config = TopologyConfig(seed_search_radius_m=0.5)
    assert select_free_space(patch, (0.9, 2.0), config).any()
    assert not select_free_space(patch, (0.2, 2.0), config).any()
    assert not select_free_space(patch, (-50.0, 2.0), config).any()
    with pytest.raises(InputError, match='finite'):
        select_free_space(patch, (float('nan'), 0.0), config)


def test_parts_of_several_seeds_of_which_some_are_nowhere():
    patch = drawn('##########', '#..#..#..#', '#..#..#..#', '##########')
    all_parts = select_free_space(patch, None, TopologyConfig())
    places = np.array([[1.5, 1.5], [7.5, 1.5], [-50.0, 2.0]])
    found = select_free_space(patch, places, TopologyConfig())
    assert found[:, :30].any() and found[:, 65:].any() and not found[:, 35:65].any()
    assert np.array_equal(found[:, :30], all_parts[:, :30])
    assert not select_free_space(patch, places[2:], TopologyConfig()).any()


def test_parts_smaller_than_the_robot_are_noise():
    cells = np.full((40, 40), 100)
    cells[5:12, 5:12] = 0
    cells[20:38, 20:38] = 0
    free = select_free_space(patch_of(cells), None, TopologyConfig(robot_radius_m=0.3))
    assert label(free)[1].size == 2 and free[28, 28] and not free[8, 8]


@pytest.mark.parametrize(
    ('largest_m2', 'small_m2', 'stays'),
    [(100.0, 1.8, False), (100.0, 2.2, True), (20.0, 0.8, False), (20.0, 1.2, True)],
)
def test_a_part_below_2_m2_and_5_percent_of_the_largest_is_an_island(
    largest_m2: float, small_m2: float, stays: bool
) -> None:
    standing = np.zeros((60, 300), dtype=np.bool_)
    standing[2:52, 2 : 2 + round(largest_m2 * 2)] = True
    standing[54:58, 2 : 2 + round(small_m2 * 25)] = True
    kept = without_islands(standing, 0.1)
    assert kept[:53].sum() == standing[:53].sum()
    assert kept[53:].any() == stays


def test_no_cells_are_no_island() -> None:
    assert not without_islands(np.zeros((4, 5), dtype=np.bool_), 0.1).any()
