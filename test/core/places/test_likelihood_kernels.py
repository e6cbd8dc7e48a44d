"""Likelihood kernels compared with a plain reference."""

import math

import numpy as np
import pytest
from support.small_floor import CELL_M, OFFICE, START, drive, floor, map_of

from thinmap_ros.core import se2
from thinmap_ros.core.grid.fields import distance_cells
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.places import likelihood
from thinmap_ros.core.places.likelihood import Judge
from thinmap_ros.core.places.place_database import (
    DIRECTIONS,
    NEAR_UNIT_M,
    NODE_WINDOW_M,
    RANGE_UNIT_M,
    SIGHT_UNIT_M,
    GlobalLocalizationConfig,
    Places,
    calibrate,
    free_way,
    observe,
    observed_beams,
    profile,
)
from thinmap_ros.core.places.wall_field import FREE, UNKNOWN, WALL

CONFIG = GlobalLocalizationConfig()


@pytest.fixture(scope='module')
def places():
    return Places.of(*map_of(OFFICE), CONFIG)


@pytest.fixture(scope='module')
def seen():
    scan, _, _ = next(drive(OFFICE, START, []))
    return observe(scan, CELL_M, CONFIG)


@pytest.fixture(scope='module')
def poses():
    rng = np.random.default_rng(4)
    return np.column_stack(
        [rng.uniform(-1.5, 8.5, 200), rng.uniform(1.5, 8.5, 200), rng.uniform(-7.0, 7.0, 200)]
    )


def origin(places):
    return (places.frame.origin_x, places.frame.origin_y)


def test_range_scores_are_the_sums_of_a_table(places, seen, poses):
    table = np.cos(np.arange(256.0))
    ends = seen.ends[seen.met]
    found = likelihood.range_scores(poses, ends, places.near, origin(places), CELL_M, table)
    for T, score in zip(poses, found, strict=True):
        cells = places.frame.cells_of(se2.transform_points(T, ends))
        inside = ((cells >= 0) & (cells < places.near.shape)).all(axis=1)
        values = np.full(len(cells), table[255])
        values[inside] = table[places.near[cells[inside, 0], cells[inside, 1]]]
        assert score == pytest.approx(values.sum())


def nodes_in_sight(places, block):
    low = places.first[block]
    high = places.first[block + 1]
    row, col = np.argwhere(places.blocks == block)[0]
    corner = np.array([col, row]) * places.block_cells * CELL_M + origin(places)
    return corner + places.in_sight[:, low:high].T * SIGHT_UNIT_M


def test_nodes_in_sight_of_a_block_are_those_of_the_map_that_nothing_hides(places):
    cells = places.frame.cells_of(places.nodes)
    for row, col in places.standing[::211]:
        block = places.blocks[row // places.block_cells, col // places.block_cells]
        own = (
            places.standing // places.block_cells
            == (row // places.block_cells, col // places.block_cells)
        ).all(1)
        lead = places.standing[own][0]
        reach = NODE_WINDOW_M / 2.0 / CELL_M + places.block_cells
        expected = [
            node
            for node, cell in zip(places.nodes, cells, strict=True)
            if np.abs(cell - lead).max() <= reach
            and line_is_clear(places.states == FREE, *lead, *cell)
        ]
        found = nodes_in_sight(places, block)
        assert len(found) == len(expected)
        for node in expected:
            assert np.abs(found - node).max(axis=1).min() <= SIGHT_UNIT_M


def test_node_scores_are_those_of_the_nearest_node_in_sight(places, poses):
    rng = np.random.default_rng(1)
    nodes = rng.normal(0.0, 2.0, (10, 2))
    kinds = rng.integers(0, 3, 10)
    nodes[0] = (300.0, -200.0)
    model = np.array([0.3, 0.8, 0.5]), np.array([0.4, 0.3, 0.5]), np.array([20.0, 30.0, 10.0])
    sights = (places.blocks, places.first, places.in_sight)
    block_m = places.block_cells * CELL_M
    found = likelihood.node_scores(poses, nodes, kinds, sights, origin(places), block_m, *model)
    for T, score in zip(poses, found, strict=True):
        col, row = np.trunc((T[:2] - origin(places)) / block_m).astype(int)
        inside = 0 <= row < places.blocks.shape[0] and 0 <= col < places.blocks.shape[1]
        block = places.blocks[row, col] if inside else -1
        known = nodes_in_sight(places, block) if block >= 0 else []
        expected = 0.0
        for at, kind in zip(se2.transform_points(T, nodes), kinds, strict=True):
            q, sigma, gain = (numbers[kind] for numbers in model)
            nearest = min((np.hypot(*(node - at)) for node in known), default=np.inf)
            agrees = math.exp(-0.5 * (nearest / sigma) ** 2) if nearest < 5.0 * sigma else 0.0
            expected += math.log(1.0 - q + q * gain * agrees)
        # Positions of nodes and squared distances are quantized: ten nodes are off by a
        # little each.
        assert score == pytest.approx(expected, abs=0.05)


def marched(states, x, y, angle, most):
    """Distance to the first cell that is not free, in small steps."""
    for way in np.arange(0.0, most, 0.002):
        row = math.floor(y + way * math.sin(angle))
        col = math.floor(x + way * math.cos(angle))
        if not (0 <= row < states.shape[0] and 0 <= col < states.shape[1]):
            return way, UNKNOWN
        if states[row, col] != FREE:
            return way, int(states[row, col])
    return most, FREE


def test_free_way_ends_where_small_steps_do(places):
    rng = np.random.default_rng(2)
    for row, col in places.standing[rng.integers(len(places.standing), size=40)]:
        x = col + rng.random()
        y = row + rng.random()
        angle = rng.uniform(-4.0, 4.0)
        way, state = free_way(places.states, x, y, angle, 30.0)
        plain_way, plain_state = marched(places.states, x, y, angle, 30.0)
        assert state == plain_state
        assert way == pytest.approx(plain_way, abs=0.01)


def test_the_true_pose_explains_nearly_all_and_one_behind_a_wall_little(places, seen):
    T = se2.pose(*START)
    tried = np.array([T, T + (4.5, 1.0, 0.0), T + (0.0, 0.0, 1.5)])
    counts, silent = likelihood.explained(
        tried,
        seen.laser,
        seen.ranges_m,
        seen.bearings_rad,
        seen.met,
        (places.states, places.near),
        origin(places),
        CELL_M,
        (0.2, 0.03),
    )
    assert counts[0] >= 0.95 * len(seen.ranges_m)
    assert (counts[1:] < 0.7 * len(seen.ranges_m)).all()
    assert not silent[:2].any()  # rotated, beams end outside the map


def test_of_the_unknown_the_map_says_nothing(places, seen):
    states = np.where(places.states == WALL, np.uint8(UNKNOWN), places.states)
    near = np.full_like(places.near, 255)
    # Each hit is slightly inside unknown space: if noise shortens the range, the
    # map is informative.
    x, y = (se2.pose(*START)[:2] - origin(places)) / CELL_M
    ways = [free_way(states, x, y, START[2] + bearing, 500.0)[0] for bearing in seen.bearings_rad]
    ranges = np.where(seen.met, (np.array(ways) + 1e-3) * CELL_M, seen.ranges_m)
    counts, silent = likelihood.explained(
        se2.pose(*START)[None],
        seen.laser,
        ranges,
        seen.bearings_rad,
        seen.met,
        (states, near),
        origin(places),
        CELL_M,
        (0.2, 0.03),
    )
    assert silent[0] >= seen.met.sum() > 0.5 * len(ranges)
    assert counts[0] + silent[0] <= len(ranges)


def test_refinement_comes_back_to_the_true_pose_and_never_fits_worse(places, seen):
    table = np.exp(-0.5 * (np.arange(256) * NEAR_UNIT_M / 0.15) ** 2)
    ends = seen.ends[seen.met]
    steps = np.array([[0.08, 0.03], [0.04, 0.015], [0.02, 0.008]])
    starts = se2.pose(*START) + np.array([[0.1, -0.1, 0.05], [-0.12, 0.05, -0.06], [0.0, 0.0, 0.0]])
    free = np.zeros((3, 3, 3))
    before = likelihood.range_scores(starts, ends, places.near, origin(places), CELL_M, table)
    found, scores = likelihood.refine(
        starts, ends, places.near, origin(places), CELL_M, table, steps, 8, starts, free
    )
    assert (scores >= before).all()
    assert np.hypot(*(found - START)[:, :2].T).max() < 0.12
    held, _ = likelihood.refine(
        starts,
        ends,
        places.near,
        origin(places),
        CELL_M,
        table,
        steps,
        8,
        starts,
        free + np.eye(3) * 1e9,
    )
    assert held == pytest.approx(starts)


def test_spots_are_those_whose_ranges_agree_best(places, seen):
    ranges, known, met = profile(seen)
    slack = 0.3 + 0.05 * ranges
    low = np.where(known, np.clip((ranges - slack) / RANGE_UNIT_M, 0.0, 254.0), 0.0).astype(
        np.uint8
    )
    high = np.where(
        known & met, np.clip((ranges + slack) / RANGE_UNIT_M, 0.0, 255.0), 255.0
    ).astype(np.uint8)
    spots, headings, counts = likelihood.spot_scores(places.around, low, high, 0)
    for k in range(0, len(spots), 97):
        turned = np.roll(places.around[spots[k]], -headings[k])
        assert counts[k] == ((turned >= low) & (turned <= high)).sum()
    best = int(counts.argmax())
    assert np.hypot(*(places.spots[spots[best]] - START[:2])) < 0.5
    assert abs(se2.wrap(headings[best] * 2.0 * np.pi / DIRECTIONS - START[2])) < 0.2


def test_distances_to_walls_are_exact_where_they_fit_a_byte(places):
    exact = distance_cells(places.states == WALL) * CELL_M
    near = places.near * NEAR_UNIT_M
    fits = exact < 1.0
    assert np.abs(near - exact)[fits].max() <= NEAR_UNIT_M
    assert (near[~fits] >= 1.0 - NEAR_UNIT_M).all()


def test_of_poses_whose_beams_would_have_to_pass_walls_one_that_explains_them_is_taken():
    hall = floor((20, 0, 22, 40), (20, 48, 22, 90), rows=60, cols=90)  # a door in the robot's view
    places = Places.of(*map_of(hall), CONFIG)
    scan, _, T = next(drive(hall, (3.4, 2.8, 1.57), []))
    judge = Judge(places, CONFIG, calibrate(places, scan, CONFIG, np.random.default_rng(0)))
    seen = observed_beams(scan, CONFIG)
    beside = T + np.array([0.45, 0.0, 0.0])
    assert judge.explained(beside[None], seen)[0][0] < judge.explained(T[None], seen)[0][0]
    others = np.stack([beside - (0.1, 0.0, 0.0), T])[None]
    assert np.array_equal(judge.unblocked(beside[None], seen, others)[0], T)
    assert np.array_equal(judge.unblocked(T[None], seen, others)[0], T)
