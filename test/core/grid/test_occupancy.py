"""The grid's Bayes update, compared with a reference, and its invariants."""

import math
from dataclasses import replace

import numpy as np
import pytest
from reference_grid import PlainGrid

from thinmap_ros.core.grid.occupancy import (
    P_MAX,
    P_MIN,
    PAPER_GRID,
    OccupancyConfig,
    OccupancyGrid,
    log_odds,
)
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.grid.raytrace import cast_rays
from thinmap_ros.core.grid.tiles import TILE
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import compose, pose

STEP = math.radians(1.0)


def scan_of(ranges, **changes):
    ranges = np.asarray(ranges, dtype=float)
    fields = {
        'angle_min_rad': -math.pi / 2,
        'angle_increment_rad': STEP,
        'range_min_m': 0.1,
        'range_max_m': 8.0,
    }
    return Scan.create(0, ranges, **(fields | changes))


def percent(grid, x, y):
    return int(grid.window(x, y, 0.1).cells[0, 0])


def reference(scan, T, config):
    """Cells traversed and hit, by fine sampling of beams: inexact only at cell corners."""
    passed = set()
    hit = set()
    ranges = np.where(scan.hit, scan.ranges_m + config.surface_thickness_m, scan.ranges_m)
    for r, angle in zip(ranges, scan.angles_rad + T[2], strict=True):
        reach = min(r, scan.max_range_m) if r < scan.range_max_m else config.no_return_clear_range_m
        along = np.arange(0.0, reach, 0.002)
        cells = np.floor(
            np.column_stack([T[1] + along * math.sin(angle), T[0] + along * math.cos(angle)]) / 0.1
        )
        passed |= {tuple(c) for c in cells.astype(int).tolist()}
        if r < min(scan.range_max_m, scan.max_range_m):
            row = math.floor((T[1] + r * math.sin(angle)) / 0.1)
            col = math.floor((T[0] + r * math.cos(angle)) / 0.1)
            hit.add((row, col))
    return passed - hit, hit


@pytest.mark.parametrize('seed', range(5))
def test_one_scan_marks_what_a_finely_sampled_reference_marks(seed):
    rng = np.random.default_rng(seed)
    scan = scan_of(np.where(rng.random(181) < 0.1, np.inf, rng.uniform(0.3, 7.0, 181)))
    T = np.array([*rng.uniform(-3, 3, 2), rng.uniform(-3, 3)])
    config = PAPER_GRID
    grid = OccupancyGrid(config)
    grid.add_scan(scan, T)
    passed, hit = reference(scan, T, config)
    patch = grid.known_area()
    offset = np.round([patch.frame.origin_y / 0.1, patch.frame.origin_x / 0.1]).astype(int)
    found_hit = {tuple((c + offset).tolist()) for c in np.argwhere(patch.cells >= 65)}
    found_passed = {
        tuple((c + offset).tolist()) for c in np.argwhere((patch.cells >= 0) & (patch.cells < 65))
    }
    assert found_hit == hit
    # A beam may cut the corner of a cell by less than the reference's step, and some
    # neighbours of these random ranges look like a surface.
    assert len(found_passed ^ passed) <= 0.02 * len(passed)


def test_each_cell_counts_once_a_scan_and_is_clamped():
    config = PAPER_GRID
    grid = OccupancyGrid(config)
    wall = scan_of(np.full(181, 1.0))
    grid.add_scan(wall, pose(0.05, 0.05, 0))
    once = 100 / (1 + math.exp(-log_odds(config.p_miss)))
    assert percent(grid, 0.25, 0.05) == round(once)
    for _ in range(50):
        grid.add_scan(wall, pose(0.05, 0.05, 0))
    assert percent(grid, 0.25, 0.05) == round(100 * P_MIN)
    assert percent(grid, 1.05, 0.05) == round(100 * P_MAX)


def test_a_wall_that_went_away_is_unlearned():
    grid = OccupancyGrid(PAPER_GRID)
    for _ in range(100):
        grid.add_scan(scan_of(np.full(181, 1.0)), pose(0.05, 0.05, 0))
    for _ in range(12):
        grid.add_scan(scan_of(np.full(181, 2.0)), pose(0.05, 0.05, 0))
    assert grid.window(1.05, 0.05, 0.1).free.all()


def test_cells_beyond_a_hit_are_not_updated():
    grid = OccupancyGrid(PAPER_GRID)
    grid.add_scan(scan_of(np.full(181, 1.0)), pose(0.05, 0.05, 0))
    assert percent(grid, 1.35, 0.05) == -1
    assert percent(grid, -0.55, 0.05) == -1


@pytest.mark.parametrize('value', [np.nan, 0.0, -1.0, 0.05, -np.inf])
def test_invalid_beams_change_nothing(value):
    grid = OccupancyGrid(PAPER_GRID)
    grid.add_scan(scan_of(np.full(181, value)), pose(0, 0, 0))
    assert grid.known_area().unknown.all()


@pytest.mark.parametrize('place', [(0.0, 0.0), (9.0, 0.0), (-9.0, 0.0), (0.0, 9.0), (300.0, -9.0)])
def test_a_scan_that_shows_nothing_leaves_the_picture_as_it_was(place):
    grid = OccupancyGrid(PAPER_GRID)
    grid.add_scan(scan_of(np.full(181, 3.0)), pose(0.0, 0.0, 0.3))
    before = grid.known_area()
    grid.add_scan(scan_of(np.full(181, np.nan)), pose(*place, 0.3))
    after = grid.known_area()
    assert after.frame == before.frame
    assert np.array_equal(after.cells, before.cells)


def test_a_beam_without_return_frees_up_to_the_configured_range():
    grid = OccupancyGrid(replace(PAPER_GRID, no_return_clear_range_m=3.0))
    for _ in range(2):
        grid.add_scan(scan_of(np.full(181, np.inf)), pose(0.05, 0.05, 0))
    assert grid.window(2.85, 0.05, 0.1).free.all()
    assert percent(grid, 3.25, 0.05) == -1
    assert not grid.known_area().occupied.any()


def test_a_hit_beyond_the_usable_range_frees_cells_and_marks_no_wall():
    grid = OccupancyGrid(PAPER_GRID)
    for _ in range(2):
        scan = replace(scan_of(np.full(181, 5.0)), max_range_m=3.0)
        grid.add_scan(scan, pose(0.05, 0.05, 0))
    assert grid.window(2.85, 0.05, 0.1).free.all()
    assert not grid.known_area().occupied.any()


def test_the_map_grows_in_any_direction_in_memory_proportional_to_what_was_seen():
    grid = OccupancyGrid(PAPER_GRID)
    for x, y in [(0, 0), (500, 0), (-300, 400), (0, -900)]:
        grid.add_scan(scan_of(np.full(181, 1.0)), pose(x + 0.05, y + 0.05, 0))
        assert percent(grid, x + 1.05, y + 0.05) == 80
    assert grid._tiles.used <= 16
    assert percent(grid, 1.05, 0.05) == 80


@pytest.mark.parametrize('axis', range(3))
@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
def test_a_pose_that_is_not_finite_changes_nothing(axis, value):
    grid = OccupancyGrid(PAPER_GRID)
    T = np.zeros(3)
    T[axis] = value
    grid.add_scan(scan_of(np.full(181, 1.0)), T)
    assert grid.known_area().unknown.all()


def test_a_window_is_aligned_with_the_map_and_unknown_where_nothing_is():
    grid = OccupancyGrid(PAPER_GRID)
    grid.add_scan(scan_of(np.full(181, 1.0)), pose(0.05, 0.05, 0))
    window = grid.window(0.32, -0.17, 10.0)
    assert window.shape == (100, 100)
    assert window.frame.origin_x / 0.1 == pytest.approx(round(window.frame.origin_x / 0.1))
    assert grid.window(1000.0, 0.0, 1.0).unknown.all()


def test_a_saved_map_is_resumed():
    grid = OccupancyGrid(PAPER_GRID)
    for _ in range(3):
        grid.add_scan(scan_of(np.full(181, 1.0)), pose(0.05, 0.05, 0))
    again = OccupancyGrid.from_patch(grid.known_area())
    np.testing.assert_array_equal(again.known_area().cells, grid.known_area().cells)
    again.add_scan(scan_of(np.full(181, 2.0)), pose(0.05, 0.05, 0))
    assert percent(again, 2.05, 0.05) == 80


def test_the_resolution_of_a_finished_map_is_taken_over():
    cells = np.full((4, 5), 100, dtype=np.int8)
    grid = OccupancyGrid.from_patch(
        GridPatch(GridFrame(1.0, 2.0, 0.02), cells), OccupancyConfig(resolution_m=0.05)
    )
    assert grid.frame.resolution == 0.02
    assert grid.known_area().occupied.sum() == cells.size


def test_beams_that_graze_a_wall_do_not_erase_it():
    """A wall along y = 1.03, at the centre of its cells, passed repeatedly at a distance."""
    grid = OccupancyGrid(PAPER_GRID)
    angles = -math.pi / 2 + STEP * np.arange(181)
    for x in np.arange(-6.0, 0.0, 0.05):
        with np.errstate(divide='ignore'):
            ranges = np.where(np.sin(angles) > 0.0, (1.03 - 0.4) / np.sin(angles), np.inf)
        grid.add_scan(scan_of(np.where(ranges < 8.0, ranges, np.inf)), pose(x, 0.4, 0))
    row = grid.window(0.0, 1.05, 8.0)
    wall = row.cells[row.frame.cells_of(np.array([[0.0, 1.05]]))[0][0]]
    columns = row.frame.cells_of(np.array([[-3.5, 1.05], [2.0, 1.05]]))[:, 1]
    assert (wall[columns[0] : columns[1]] >= 65).all()


def test_a_wall_on_the_boundary_of_two_cells_leaves_the_one_in_front_free():
    grid = OccupancyGrid(PAPER_GRID)
    rng = np.random.default_rng(4)
    bearings = np.radians(np.arange(-90.0, 91.0))
    for _ in range(30):
        # A wall along x = 2.0, observed with 1 cm of noise.
        with np.errstate(divide='ignore'):
            ranges = 2.0 / np.cos(bearings) + rng.normal(0.0, 0.01, 181)
        grid.add_scan(
            scan_of(np.where(np.abs(bearings) < 0.8, ranges, np.nan)), pose(0.0, 0.05, 0.0)
        )
    beside = [percent(grid, 1.95, y) for y in np.arange(-1.45, 1.5, 0.1)]
    behind = [percent(grid, 2.05, y) for y in np.arange(-1.45, 1.5, 0.1)]
    assert max(beside) <= 25
    assert min(behind) >= 65


def seen_from(x, y, heading, wall_y, solid=True):
    """Scan of a wall from (0, wall_y) to (2.4, wall_y), 0.1 m thick, in front of one at x = -1."""
    world = np.zeros((500, 500), dtype=np.uint8)
    world[:, 75:80] = 1
    if solid:
        world[round((wall_y + 1.95) / 0.02) : round((wall_y + 2.05) / 0.02), 100:220] = 1
    angles = math.radians(-90.0) + STEP * np.arange(181)
    ranges = 0.02 * cast_rays(world, (x + 2.0) / 0.02, (y + 2.0) / 0.02, angles + heading, 400.0)
    return scan_of(np.where(ranges < 8.0, ranges, np.inf))


@pytest.mark.parametrize('y', [1.98, 2.0, 2.02])
def test_looking_along_a_wall_does_not_erase_it(y):
    grid = OccupancyGrid(PAPER_GRID)
    for _ in range(20):
        grid.add_scan(seen_from(1.5, 0.5, math.pi / 2, 2.0), pose(1.5, 0.5, math.pi / 2))
    wall = np.column_stack([np.arange(0.25, 2.3, 0.1), np.full(21, 1.95)])
    before = grid.known_area()
    assert before.occupied[tuple(before.frame.cells_of(wall).T)].all()
    for heading in np.radians(np.linspace(170.0, 190.0, 60)):
        grid.add_scan(seen_from(5.3, y, heading, 2.0), pose(5.3, y, heading))
    after = grid.known_area()
    assert after.occupied[tuple(after.frame.cells_of(wall).T)].mean() > 0.9


def test_a_long_wall_that_went_away_is_unlearned_by_beams_that_cross_it():
    grid = OccupancyGrid(PAPER_GRID)
    for _ in range(20):
        grid.add_scan(seen_from(1.5, 0.5, math.pi / 2, 2.0), pose(1.5, 0.5, math.pi / 2))
    for x in np.linspace(0.5, 2.5, 30):
        grid.add_scan(seen_from(x, 0.5, math.pi / 2, 2.0, solid=False), pose(x, 0.5, math.pi / 2))
    wall = np.column_stack([np.arange(0.25, 2.3, 0.1), np.full(21, 1.95)])
    patch = grid.known_area()
    assert patch.free[tuple(patch.frame.cells_of(wall).T)].all()


def drive_through_clutter(seed, scans=25):
    """Scans on a curve among posts and walls; some beams are invalid or without return."""
    rng = np.random.default_rng(seed)
    world = np.zeros((600, 600), dtype=np.uint8)
    world[[0, -1]] = 1
    world[:, [0, -1]] = 1
    world[300:305, 100:420] = 1
    for row, col in rng.integers(0, 580, (25, 2)):
        world[row : row + 8, col : col + 8] = 1
    T = pose(4.0, 4.0, 0.3)
    angles = math.radians(-90.0) + STEP * np.arange(181)
    for _ in range(scans):
        reach = cast_rays(world, T[0] / 0.02, T[1] / 0.02, angles + T[2], 500.0)
        ranges = 0.02 * reach + rng.normal(0.0, 0.01, 181)
        spoilt = rng.random(181) < 0.05
        ranges[spoilt] = rng.choice(
            [np.nan, np.inf, -np.inf, 0.0, -1.0, 0.01, 7.99, 8.0, 1e9], spoilt.sum()
        )
        yield scan_of(ranges, T_base_laser=pose(0.1, -0.02, 0.01)), T
        T = compose(T, pose(0.1, 0.0, 0.06))


def known_cells(grid):
    """Log odds by (row, col) of all observed cells of a grid."""
    state = grid.state()
    cells = [
        (tile, *at)
        for tile, odds in enumerate(state['log_odds'])
        for at in np.argwhere(odds).tolist()
    ]
    first = (TILE * state['tiles']).tolist()
    return {
        (first[t][0] + r, first[t][1] + c): int(state['log_odds'][t, r, c]) for t, r, c in cells
    }


@pytest.mark.parametrize(
    ('seed', 'config', 'max_range_m'),
    [
        (0, PAPER_GRID, 30.0),
        (
            1,
            OccupancyConfig(
                resolution_m=0.05, no_return_clear_range_m=2.0, surface_thickness_m=0.0
            ),
            30.0,
        ),
        (2, OccupancyConfig(resolution_m=0.25), 3.0),
    ],
)
def test_all_cells_are_those_of_the_plain_grid_bit_for_bit(seed, config, max_range_m):
    grid = OccupancyGrid(config)
    plain = PlainGrid(config)
    for measured, T in drive_through_clutter(seed):
        scan = replace(measured, max_range_m=max_range_m)
        # The opposite direction, too: into negative rows and columns.
        for at in (T, np.array([-T[0], -T[1], T[2] + math.pi])):
            grid.add_scan(scan, at)
            plain.update(scan, at)
    assert known_cells(grid) == plain.odds
    assert not grid._increments.any()


@pytest.mark.parametrize('seed', range(3))
def test_the_whole_map_is_the_same_however_often_it_was_looked_at(seed):
    rng = np.random.default_rng(seed)
    watched = OccupancyGrid(PAPER_GRID)
    for _ in range(12):
        scan = scan_of(rng.uniform(0.5, 9.0, 181))
        watched.add_scan(scan, pose(*rng.uniform(-15.0, 15.0, 2), rng.uniform(-3.0, 3.0)))
        seen = watched.known_area()
        fresh = OccupancyGrid.from_state(watched.state()).known_area()
        assert seen.frame == fresh.frame
        assert np.array_equal(seen.cells, fresh.cells)
        known = seen.cells != -1
        assert known[[0, -1]].any(axis=1).all() and known[:, [0, -1]].any(axis=0).all(), (
            'no rectangle is smaller'
        )
