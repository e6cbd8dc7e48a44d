"""A grid that is re-rendered in slices equals one that is re-rendered at once."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.slam_room import corridor_ring, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.grid import correction as rerendering
from thinmap_ros.core.grid.correction import MAX_OPEN, CorrectableGrid, Rerendering, StoredScan
from thinmap_ros.core.grid.occupancy import (
    P_MAX,
    P_MIN,
    PAPER_GRID,
    OccupancyConfig,
    OccupancyGrid,
    log_odds,
)
from thinmap_ros.core.grid.patch import UNKNOWN
from thinmap_ros.core.grid.tiles import TILE
from thinmap_ros.core.scan import LaserConfig, Scan
from thinmap_ros.core.stage import Destination

WALLS = corridor_ring()
CORNERS = np.array([[1.2, 1.2], [38.8, 1.2], [38.8, 18.8], [1.2, 18.8], [1.2, 1.2]])
APART_M = 0.4


def ring_poses():
    """True poses (N, 3) of a lap of the corridor."""
    poses = []
    for a, b in pairwise(CORNERS):
        heading = np.arctan2(*(b - a)[::-1])
        for s in np.arange(0.0, np.hypot(*(b - a)), APART_M):
            poses.append([*(a + s * np.array([np.cos(heading), np.sin(heading)])), heading])
    return np.array(poses)


TRUE = ring_poses()
SCANS = [
    scan_in(WALLS, T, np.random.default_rng(k), k, se2.pose(0.1, 0.05, 0.3))
    for k, T in enumerate(TRUE)
]


@pytest.fixture
def small_slices(monkeypatch):
    monkeypatch.setattr(rerendering, '_TILES_PER_SLICE', 24)


def drifted(poses, rad_a_step):
    """Poses (N, 3) of a robot whose heading drifts."""
    believed = [poses[0]]
    for a, b in pairwise(poses):
        believed.append(se2.compose(believed[-1], se2.between(a, b) + [0.0, 0.0, rad_a_step]))
    return np.array(believed)


def correction(rng, count, spread_m):
    """Stamps (M,) of some early scans, and poses (M, 3) near the true ones."""
    stamps = np.flatnonzero(rng.random(count) < 0.2)
    return stamps, TRUE[stamps] + rng.normal(0.0, spread_m, (len(stamps), 3)) * [1.0, 1.0, 0.1]


class Drive:
    """The same drive and corrections with a grid re-rendered in slices or at once."""

    def __init__(self, in_one_go):
        self.map = CorrectableGrid(OccupancyGrid(PAPER_GRID))
        self.in_one_go = in_one_go
        self.moved = []

    def correct(self, stamps, poses, since_ns, T_map_base):
        self.map.apply_correction(stamps, poses, since_ns)
        if self.in_one_go:
            self.note(self.map.update(None, T_map_base) or self.map.finish())

    def add(self, k, T_map_base, is_lost):
        self.note(self.map.update(None if is_lost else SCANS[k], T_map_base))

    def note(self, moved):
        if moved is not None:
            self.moved.append(moved)


def run(seed, times, in_one_go):
    """A drive of 200 scans with corrections before the scans of these numbers."""
    rng = np.random.default_rng(seed)
    drive = Drive(in_one_go)
    believed = drifted(TRUE[:200], 0.002)
    for k in range(200):
        if k in times:
            stamps, poses = correction(rng, k, 0.2)
            drive.correct(stamps, poses, k, TRUE[k])
            believed[k:] = drifted(TRUE[k:200], 0.001)
        drive.add(k, believed[k], is_lost=rng.random() < 0.05)
    drive.note(drive.map.finish())
    return drive


@pytest.mark.usefixtures('small_slices')
@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10**6), st.sets(st.integers(1, 199), min_size=1, max_size=4))
def test_in_the_end_slices_give_what_rendering_in_one_go_gives(seed, times):
    sliced = run(seed, times, False)
    at_once = run(seed, times, True)
    assert len(at_once.moved) == len(times) and 1 <= len(sliced.moved) <= len(times)
    assert sliced.map.corrected_ns == at_once.map.corrected_ns == max(times)
    one = sliced.map.shown.known_area()
    other = at_once.map.shown.known_area()
    assert one.frame == other.frame
    np.testing.assert_array_equal(one.cells, other.cells)


@pytest.mark.usefixtures('small_slices')
def test_a_correction_during_a_rerendering_starts_it_again():
    drive = run(3, {150, 152}, False)
    assert len(drive.moved) == 1 and drive.map.corrected_ns == 152
    believed = drifted(TRUE[:200], 0.002)[:150]
    first = drive.moved[0].before[:130]
    off = [np.abs(believed - T).sum(axis=1).min() for T in first]
    assert max(off) < 1e-9, 'moved from where they were before the first of the two'


def drifted_map(count):
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID))
    for k, T in enumerate(drifted(TRUE[:count], 0.003)):
        grid.update(SCANS[k], T)
    return grid


def tiles_of(grid):
    """Log odds of each tile by its coordinates."""
    state = grid.state()
    return dict(zip(map(tuple, state['tiles'].tolist()), state['log_odds'], strict=True))


@pytest.mark.usefixtures('small_slices')
def test_each_tile_shows_the_old_rendering_until_its_new_one_is_complete_near_ones_first():
    grid = drifted_map(250)
    whole = drifted_map(250)
    old = tiles_of(grid.shown)
    stamps = np.arange(250)
    for each in (grid, whole):
        each.apply_correction(stamps, TRUE[:250], 250)
    whole.update(None, TRUE[250])
    whole.finish()
    new = tiles_of(whole.shown)
    nothing = np.zeros((TILE, TILE), dtype=np.int16)
    robot = tuple((OccupancyGrid(PAPER_GRID).frame.cells_of(TRUE[250:251, :2])[0] // TILE).tolist())
    shown_at = {}
    step = 0
    while grid.is_rerendering:
        grid.update(None, TRUE[250])
        step += 1
        for place, cells in tiles_of(grid.shown).items():
            is_new = np.array_equal(cells, new.get(place, nothing))
            assert is_new or np.array_equal(cells, old.get(place, nothing)), place
            if is_new:
                shown_at.setdefault(place, step)
    assert step > 20
    changed = {p for p in new if not np.array_equal(new[p], old.get(p, nothing))}
    ring = {p: max(abs(p[0] - robot[0]), abs(p[1] - robot[1])) for p in changed}
    first = [min(shown_at[p] for p in changed if ring[p] == r) for r in sorted({*ring.values()})]
    assert first == sorted(first) and first[0] < first[-1]
    assert shown_at[robot] < step / 2


@pytest.mark.usefixtures('small_slices')
def test_new_scans_are_shown_at_once_and_stay_shown():
    grid = drifted_map(120)
    grid.apply_correction(np.arange(120), TRUE[:120], 120)
    news = OccupancyGrid(PAPER_GRID)
    k = 120
    while grid.is_rerendering:
        grid.update(SCANS[k], TRUE[k])
        news.add_scan(SCANS[k], TRUE[k])
        for row, col in np.argwhere(news.known_area().cells >= 0)[::7].tolist():
            x, y = news.known_area().frame.centres_of(np.array([[row, col]]))[0]
            assert grid.shown.window(x, y, 0.1).cells[0, 0] >= 0, (x, y)
        k += 1
    assert k > 150


def test_a_slice_does_a_bounded_part_of_the_work():
    """A slice renders scans of a bounded number of tiles, for any length of the drive."""
    kept = [StoredScan.of(scan, PAPER_GRID) for scan in SCANS]
    work = Rerendering(OccupancyGrid(PAPER_GRID), kept * 2, np.tile(TRUE, (2, 1)), TRUE[0])
    shown = OccupancyGrid(PAPER_GRID)
    slices = []
    while not work.is_complete:
        before = work._next
        work.render_slice(shown)
        slices.append(sum(work._tiles[before : work._next]))
    assert work._next == 2 * len(SCANS)
    assert max(slices) <= rerendering._TILES_PER_SLICE
    assert len(slices) < 1.2 * sum(slices) / rerendering._TILES_PER_SLICE + 1


def test_however_large_its_scans_a_rerendering_goes_faster_than_scans_come(monkeypatch):
    monkeypatch.setattr(rerendering, '_TILES_PER_SLICE', 0)
    grid = drifted_map(40)
    grid.apply_correction(np.arange(40), TRUE[:40], 40)
    for k in range(40, 90):
        grid.update(SCANS[k], TRUE[k])
    assert not grid.is_rerendering


@pytest.mark.parametrize('seed', range(20))
def test_a_scan_touches_no_tile_beyond_those_that_it_is_thought_to(seed):
    rng = np.random.default_rng(seed)
    config = OccupancyConfig(
        resolution_m=float(rng.choice([0.02, 0.05, 0.1])),
        no_return_clear_range_m=float(rng.uniform(0.0, 9.0)),
        surface_thickness_m=float(rng.uniform(0.0, 0.5)),
    )
    ranges = rng.uniform(0.0, rng.uniform(1.0, 8.0), 90)
    ranges[rng.random(90) < 0.3] = np.inf
    mount = se2.pose(*rng.uniform(-1.0, 1.0, 2), rng.uniform(-3.0, 3.0))
    laser = LaserConfig(max_range_m=float(rng.uniform(2.0, 9.0)))
    scan = Scan.create(0, ranges, rng.uniform(-3.0, 3.0), 0.02, 0.1, 8.0, mount, laser)
    T = se2.pose(*rng.uniform(-50.0, 50.0, 2), rng.uniform(-3.0, 3.0))
    grid = OccupancyGrid(config)
    grid.add_scan(scan, T)
    extent = StoredScan.of(scan, config).extent
    low, high = rerendering._tile_boxes([extent], T[None], grid.frame)[0]
    touched = grid.tiles()
    assert (touched >= low).all() and (touched <= high).all()
    longest = 2.0 * max(laser.max_range_m, 1.0) / config.resolution_m / TILE
    assert (high - low <= 1.5 * longest + 3).all()


def test_the_extent_of_a_scan_holds_whatever_its_beams_without_return_show():
    """Else a verdict on the laser would have to change all stored scans in one step."""
    scan = dropped(SCANS[0], np.random.default_rng(7))
    config = PAPER_GRID
    extents = [StoredScan.of(replace(scan, drops_out=d), config).extent for d in (False, True)]
    np.testing.assert_array_equal(*extents)


def test_what_is_rendered_again_at_the_same_poses_is_what_was_there():
    """All scans touch the tile of the robot: they are rendered in their original order."""
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID))
    poses = [se2.pose(3.0 + 0.3 * k, 1.2, 0.0) for k in range(12)]
    for k, T in enumerate(poses):
        grid.update(SCANS[k], T)
    before = grid.shown
    grid.apply_correction(np.arange(12), np.array(poses), 12)
    assert grid.update(None, poses[-1]) is None and grid.shown is before
    assert grid.update(None, poses[-1]) is not None and grid.shown is not before
    np.testing.assert_array_equal(grid.shown.known_area().cells, before.known_area().cells)


def dropped(scan, rng):
    """The scan without the returns of half of the beams."""
    ranges = np.where(rng.random(scan.ranges_m.size) < 0.5, np.inf, scan.ranges_m)
    return replace(scan, ranges_m=ranges)


@pytest.mark.parametrize('keeps_scans', [True, False])
def test_once_a_laser_proves_to_drop_out_its_beams_without_return_clear_nothing(keeps_scans):
    rng = np.random.default_rng(5)
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID), keeps_scans)
    clean = OccupancyGrid(PAPER_GRID)
    trusted = OccupancyGrid(PAPER_GRID)
    rebuilt = 0
    for k in range(40):
        scan = dropped(SCANS[k], rng)
        known = replace(scan, drops_out=True)
        clean.add_scan(known, TRUE[k])
        trusted.add_scan(scan if k < 20 else known, TRUE[k])
        moved = grid.update(scan if k < 20 else known, TRUE[k])
        if moved is not None:
            np.testing.assert_array_equal(moved.before, moved.after)
            rebuilt += 1
    assert rebuilt == keeps_scans
    assert not grid.is_rerendering
    expected = clean if keeps_scans else trusted
    shown = grid.shown.known_area()
    assert shown.frame == expected.known_area().frame
    same = shown.cells == expected.known_area().cells
    assert same.mean() > 0.999, 'scans are rendered in another order'
    assert trusted.known_area().free.sum() > 2 * clean.known_area().free.sum()


def test_a_laser_proves_to_drop_out_while_a_correction_is_rendered(small_slices):
    rng = np.random.default_rng(6)
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID))
    clean = OccupancyGrid(PAPER_GRID)
    for k in range(30):
        scan = dropped(SCANS[k], rng)
        clean.add_scan(replace(scan, drops_out=True), TRUE[k])
        grid.update(scan, se2.compose(TRUE[k], se2.pose(0.3, 0.0, 0.0)))
    grid.apply_correction(np.arange(30), TRUE[:30], 30)
    for k in range(30, 34):
        scan = replace(dropped(SCANS[k], rng), drops_out=k > 31)
        clean.add_scan(replace(scan, drops_out=True), TRUE[k])
        grid.update(scan, TRUE[k])
    grid.finish()
    shown = grid.shown.known_area()
    assert shown.frame == clean.known_area().frame
    assert (shown.cells == clean.known_area().cells).mean() > 0.999


def test_one_laser_that_drops_out_clears_nothing_and_the_other_does():
    rng = np.random.default_rng(5)
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID))
    expected = OccupancyGrid(PAPER_GRID)
    rebuilt = 0
    for k in range(40):
        good = replace(SCANS[k], frame='front')
        bad = replace(dropped(SCANS[k], rng), frame='rear')
        expected.add_scan(good, TRUE[k])
        expected.add_scan(replace(bad, drops_out=True), TRUE[k])
        for scan in (good, replace(bad, drops_out=k >= 20)):
            rebuilt += grid.update(scan, TRUE[k]) is not None
    grid.finish()
    assert rebuilt == 1, 'once, and not at each scan'
    shown = grid.shown.known_area()
    assert shown.frame == expected.known_area().frame
    assert (shown.cells == expected.known_area().cells).mean() > 0.999


def test_a_map_that_is_rendered_again_shows_what_each_laser_has_seen():
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID))
    for k in range(40):
        behind = replace(SCANS[k], T_base_laser=se2.pose(0.0, 0.0, np.pi))
        for frame, scan in (('front', SCANS[k]), ('rear', behind)):
            grid.update(replace(scan, frame=frame), TRUE[k])
    before = grid.shown.known_area()
    grid.apply_correction(np.arange(40), TRUE[:40], 40)
    grid.update(None, TRUE[39])
    grid.finish()
    after = grid.shown.known_area()
    assert after.frame == before.frame
    assert np.array_equal(after.cells >= 0, before.cells >= 0)


def test_a_grid_whose_scans_are_not_known_stays_as_it_is():
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID), keeps_scans=False)
    grid.update(SCANS[0], TRUE[0])
    before = grid.shown.known_area()
    assert not grid.apply_correction(np.array([0]), TRUE[[5]], 1)
    assert not grid.is_rerendering and grid.corrected_ns == 1
    assert grid.update(None, TRUE[0]) is None
    np.testing.assert_array_equal(grid.shown.known_area().cells, before.cells)


def test_tiles_hold_the_sum_of_grids_within_the_limits():
    one = OccupancyGrid(PAPER_GRID)
    other = OccupancyGrid(PAPER_GRID)
    total = OccupancyGrid(PAPER_GRID)
    for k in range(6):
        one.add_scan(SCANS[0], TRUE[0])
        if k % 2:
            other.add_scan(SCANS[20], TRUE[20])
    places = np.unique(np.vstack([one.tiles(), other.tiles()]), axis=0)
    total.set_tiles(places, one, other)
    single = tiles_of(one)
    added = tiles_of(other)
    both = tiles_of(total)
    nothing = np.zeros((TILE, TILE), dtype=np.int16)
    low, high = (round(1000 * log_odds(p)) for p in (P_MIN, P_MAX))
    for place in map(tuple, places.tolist()):
        a = single.get(place, nothing)
        b = added.get(place, nothing)
        known = (a != 0) | (b != 0)
        np.testing.assert_array_equal(both[place] != 0, known)
        expected = np.clip(a + b, low, high)
        off = np.abs(both[place] - expected)
        assert off.max() <= 1, 'even odds are a thousandth off'
        assert not off[expected != 0].any()


def test_a_scan_that_is_too_far_away_is_left_out_and_named():
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID))
    grid.update(SCANS[0], TRUE[0])
    before = grid.shown.known_area().cells
    grid.update(SCANS[1], np.array([3e3, 3e3, 0.0]))
    (refusal,) = grid.take_refusals()
    assert 'scan at 1 ns: laser at 3000.1, 3000.05 m: map of' in refusal
    assert grid.take_refusals() == []
    np.testing.assert_array_equal(grid.shown.known_area().cells, before)
    grid.update(SCANS[2], TRUE[2])
    assert grid.take_refusals() == []
    assert (grid.shown.known_area().cells != UNKNOWN).sum() > (before != UNKNOWN).sum()


def test_a_scan_that_is_too_far_away_does_not_lose_a_correction():
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID))
    for k in range(20):
        grid.update(SCANS[k], TRUE[k])
    grid.apply_correction(np.array([0, 19]), TRUE[[0, 19]], since_ns=19)
    moved = [grid.update(SCANS[20], np.array([3e3, 3e3, 0.0])) for _ in range(30)]
    assert sum(each is not None for each in moved) == 1
    assert not grid.is_rerendering
    assert len(grid.take_refusals()) == 30


def test_scans_that_a_correction_moves_too_far_away_are_left_out_and_named():
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID))
    for k in range(20):
        grid.update(SCANS[k], TRUE[k])
    far = TRUE[[0, 10, 19]] + [[0.0, 0.0, 0.0], [2e4, 2e4, 0.0], [0.0, 0.0, 0.0]]
    grid.apply_correction(np.array([0, 10, 19]), far, since_ns=19)
    while grid.is_rerendering:
        grid.update(SCANS[19], TRUE[19])
    assert grid.take_refusals(), 'those around the tenth'
    assert (grid.shown.known_area().cells != UNKNOWN).sum() > 1000


def occupied_after(destinations, correct_at=None):
    """Occupied cells of a grid after scans with these destinations, each 50 scans later."""
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID))
    for k, destination in enumerate(destinations):
        number = 50 * k
        if k == correct_at:
            numbers = [50 * i for i in range(k)]
            stamps = np.array([SCANS[i].stamp_ns for i in numbers], dtype=np.int64)
            grid.apply_correction(stamps, TRUE[numbers], SCANS[number].stamp_ns)
        # Where the place is unknown, so is the pose.
        at = TRUE[number] + (100.0 if destination is Destination.APART else 0.0)
        grid.update(SCANS[number], at, destination)
    grid.finish()
    return grid.shown.known_area().occupied.sum(), grid


MAP, OPEN, APART, NOWHERE = Destination


def test_scans_whose_placement_is_open_wait_until_it_is_decided():
    known, _ = occupied_after([MAP])
    assert occupied_after([MAP, OPEN, OPEN])[0] == known
    assert occupied_after([MAP, OPEN, OPEN, MAP])[0] == occupied_after([MAP] * 4)[0] > known
    with_gap = occupied_after([MAP, NOWHERE, NOWHERE, MAP])[0]
    assert (
        occupied_after([MAP, OPEN, OPEN, APART, MAP])[0]
        == occupied_after([MAP, NOWHERE, NOWHERE, NOWHERE, MAP])[0]
    )
    assert with_gap < occupied_after([MAP] * 4)[0]


@pytest.mark.parametrize('first', [1, 2])
def test_of_many_scans_whose_placement_is_open_the_latest_wait(first):
    """Their number is bounded: the one that was made elsewhere is dropped, or just not yet."""
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID))
    far = TRUE[0] + np.array([100.0, 0.0, 0.0])
    grid.update(SCANS[0], TRUE[0])
    for k in range(first, 2 + MAX_OPEN):
        grid.update(SCANS[0], far if k == first else TRUE[0], OPEN)
    grid.update(SCANS[0], TRUE[0])
    known = grid.shown.known_area()
    width_m = known.shape[1] * known.frame.resolution
    assert (width_m > 90.0) == (first == 2)


def test_scans_whose_placement_is_open_move_with_a_correction():
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID))
    shifted = np.array([1.0, 0.0, 0.0])
    grid.update(SCANS[0], TRUE[0] + shifted)
    grid.update(SCANS[50], TRUE[50] + shifted, OPEN)
    grid.apply_correction(np.array([SCANS[0].stamp_ns]), TRUE[:1], SCANS[100].stamp_ns)
    grid.update(SCANS[100], TRUE[100])
    grid.finish()
    assert grid.shown.known_area().occupied.sum() == occupied_after([MAP] * 3)[0]


def test_what_was_mapped_apart_is_shown_once_a_correction_joins_it():
    apart = [MAP, APART, APART]
    assert occupied_after(apart)[0] == occupied_after([MAP])[0]
    joined, grid = occupied_after([*apart, MAP], correct_at=3)
    assert joined == occupied_after([MAP] * 4)[0]
    assert not grid.is_rerendering


def test_what_was_mapped_apart_is_dropped_if_the_robot_is_placed_without_it():
    gap = occupied_after([MAP, NOWHERE, NOWHERE, MAP])[0]
    assert occupied_after([MAP, APART, APART, MAP])[0] == gap
    # A correction within the piece does not place it.
    assert (
        occupied_after([MAP, APART, APART, APART, MAP], correct_at=3)[0]
        == occupied_after([MAP, NOWHERE, NOWHERE, NOWHERE, MAP])[0]
    )


def test_saved_scans_of_a_laser_that_dropped_out_clear_nothing_once_they_are_rendered():
    """Before the laser has proved again that it does; and those of before the save stay so."""
    rng = np.random.default_rng(7)
    saved = [
        (replace(dropped(SCANS[k], rng), drops_out=True, stamp_ns=k + 1), TRUE[k])
        for k in range(20)
    ]
    clean = OccupancyGrid(PAPER_GRID)
    for scan, T in saved:
        clean.add_scan(scan, T)
    loaded = OccupancyGrid.from_state(clean.state())
    grid = CorrectableGrid(loaded, scans=saved)
    assert grid.shown is loaded, 'until the first correction'
    stamps = np.arange(20) + 1
    assert grid.apply_correction(stamps, TRUE[:20] + [0.0, 0.5, 0.0], 100)
    grid.finish()
    shown = grid.shown.known_area()
    assert shown.free.sum() == pytest.approx(clean.known_area().free.sum(), rel=0.05)
    moved = OccupancyGrid(PAPER_GRID)
    for scan, T in saved:
        moved.add_scan(scan, T + [0.0, 0.5, 0.0])
    assert (shown.cells == moved.known_area().cells).mean() > 0.999


def test_once_the_body_of_the_robot_is_known_it_is_no_wall():
    def with_body(scan):
        ranges = np.where(np.abs(scan.angles_rad - 1.0) < 0.2, 0.4, scan.ranges_m)
        return replace(scan, ranges_m=ranges)

    body_m = np.full(360, np.nan)
    body_m[180 + 45 : 180 + 70] = 0.4
    grid = CorrectableGrid(OccupancyGrid(PAPER_GRID))
    clean = OccupancyGrid(PAPER_GRID)
    for k in range(30):
        scan = with_body(SCANS[k])
        clean.add_scan(scan.without_body(body_m), TRUE[k])
        grid.update(scan if k < 20 else scan.without_body(body_m), TRUE[k])
    grid.finish()
    shown = grid.shown.known_area()
    assert shown.frame == clean.known_area().frame
    assert (shown.cells == clean.known_area().cells).mean() > 0.999
