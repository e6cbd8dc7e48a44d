"""The local map: counts, means, distances, and removed walls."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.local_map_cells import (
    CELL_M,
    REACH,
    cells_of,
    nearest,
    read_cells,
    wall_distances,
    walls_of,
)
from support.slam_room import ROOM, map_of, on_wall, seen_in

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.tiles import TILE
from thinmap_ros.core.slam.matching import local_map as module
from thinmap_ros.core.slam.matching.local_map import FIELDS, HERE, LocalMap, LocalMapConfig

BOX = ROOM[6:]
WITHOUT_BOX = ROOM[:6]
NOTHING = np.empty((0, 5))
# The box is visible from all sides.
AROUND_BOX = [
    np.array([x, y, math.atan2(2.5 - y, 7.5 - x)])
    for x, y in [(5.0, 1.0), (6.0, 4.0), (9.2, 4.0), (9.0, 1.0), (7.4, 4.2), (5.2, 2.6)]
]


def add_scan(local_map, segments, pose, rng=None):
    local_map.add_scan(seen_in(segments, pose, rng), np.zeros(3), pose)


def add(local_map, points, laser=(0.0, 0.0), angle_rad=math.pi / 2.0):
    """Points (N, 2), map frame, of a wall with a normal at an angle, seen by a laser."""
    local_map.add_scan(on_wall(points, angle_rad), np.array([*laser, 0.0]), np.zeros(3))


def cell_at(local_map, x, y):
    row = math.floor(y / CELL_M)
    col = math.floor(x / CELL_M)
    return read_cells(local_map, row, col, 1, 1)[0, 0]


def random_pose(rng):
    return np.array([*rng.uniform(1.0, 9.0, 2), rng.uniform(-np.pi, np.pi)])


def told(cells):
    """Distance of each cell from the wall that it refers to, in cells; inf without one.

    Checks that each cell that is referred to is a wall.
    """
    down = cells['to_row'].astype(int) - HERE
    right = cells['to_col'].astype(int) - HERE
    leads = cells['to_row'] > 0
    rows, cols = np.nonzero(leads)
    assert walls_of(cells)[rows + down[leads], cols + right[leads]].all()
    return np.where(leads, np.hypot(down, right), np.inf)


def test_each_cell_refers_to_its_nearest_wall(rng):
    local_map = LocalMap()
    for k in range(12):
        add_scan(local_map, ROOM, random_pose(rng), rng)
        if k % 4 == 0:
            cells, *_ = cells_of(local_map)
            assert walls_of(cells).any()
            np.testing.assert_array_equal(told(cells), nearest(cells))


def test_walls_that_vanish_are_forgotten(rng):
    """A box is removed; its nearest cells refer to other walls, or to none."""
    local_map = LocalMap()
    for pose in AROUND_BOX:
        add_scan(local_map, ROOM, pose, rng)
    faces = np.array([[7.0, 2.5], [7.5, 3.0], [8.0, 2.6]])
    assert (wall_distances(local_map, faces) < CELL_M).all()
    for _ in range(5):
        for pose in AROUND_BOX:
            add_scan(local_map, WITHOUT_BOX, pose, rng)
    cells, *_ = cells_of(local_map)
    np.testing.assert_allclose(told(cells), nearest(cells), atol=0.1)
    np.testing.assert_array_equal(wall_distances(local_map, faces), CELL_M * REACH)


# Few cells, so that adjacent walls appear and vanish.
@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1))
def test_distances_follow_walls_that_come_and_go(seed):
    rng = np.random.default_rng(seed)
    local_map = LocalMap()
    for _ in range(int(rng.integers(1, 12))):
        laser = rng.uniform(-1.0, 1.0, 2)
        add(local_map, laser + rng.uniform(-1.5, 1.5, (int(rng.integers(1, 60)), 2)), laser)
    cells, *_ = cells_of(local_map)
    truth = nearest(cells)
    found = told(cells)
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(truth))
    near = np.isfinite(truth)
    # A propagated wall may rarely be slightly farther than the nearest one.
    assert (found[near] >= truth[near]).all()
    assert (found[near] - truth[near]).max(initial=0.0) < 0.3
    assert np.mean(found[near] != truth[near]) < 0.01


def test_a_cell_keeps_the_mean_of_its_hits(rng):
    """Means of the hits, of their normals, and of the side from which they were observed."""
    points = np.array([2.0, -1.0]) + rng.uniform(0.0, CELL_M, (40, 2)) * 0.999
    angles = rng.normal(0.3, 0.2, 40)
    T_base_laser = np.array([0.1, 0.2, 0.0])
    local_map = LocalMap()
    for point, angle in zip(points, angles, strict=True):
        local_map.add_scan(on_wall(point[None], angle, 0.9), T_base_laser, np.zeros(3))
    cell = cell_at(local_map, 2.025, -0.975)
    assert cell['hits'] == cell['seen'] == 40
    mean = (points.mean(axis=0) - [2.0, -1.0]) / CELL_M
    np.testing.assert_allclose([cell['x'], cell['y']], mean, atol=1e-5)
    normals = 0.9 * np.array([np.cos(2.0 * angles).mean(), np.sin(2.0 * angles).mean()])
    np.testing.assert_allclose([cell['cos2'], cell['sin2']], normals, atol=1e-5)
    faces = -np.array([np.cos(angles).mean(), np.sin(angles).mean()])  # the laser is on their left
    np.testing.assert_allclose([cell['face_x'], cell['face_y']], faces, atol=1e-5)


@pytest.mark.parametrize('heading', [0.0, 0.7, 2.0, -1.6, 3.1])
def test_normals_and_faces_are_turned_with_the_robot(heading):
    """A wall 2 m in front of a turned robot with an offset laser: its normal faces the laser."""
    pose = np.array([1.0, -2.0, heading])
    points = on_wall(np.column_stack([np.full(21, 2.0), np.linspace(-0.5, 0.5, 21)]), 0.0)
    local_map = LocalMap()
    local_map.add_scan(points, np.array([0.3, 0.0, 0.0]), pose)
    for x, y in se2.transform_points(pose, points[:, :2]):
        cell = cell_at(local_map, x, y)
        double = [math.cos(2.0 * heading), math.sin(2.0 * heading)]
        np.testing.assert_allclose([cell['cos2'], cell['sin2']], double, atol=1e-5)
        face = [-math.cos(heading), -math.sin(heading)]
        np.testing.assert_allclose([cell['face_x'], cell['face_y']], face, atol=1e-5)


def test_a_wall_that_is_hit_from_both_sides_has_no_face():
    local_map = LocalMap()
    point = np.array([[1.02, 0.02]])
    add(local_map, point, (0.0, 0.0), 0.0)
    assert cell_at(local_map, 1.02, 0.02)['face_x'] == pytest.approx(-1.0)
    add(local_map, point, (2.0, 0.0), 0.0)
    cell = cell_at(local_map, 1.02, 0.02)
    np.testing.assert_allclose([cell['face_x'], cell['face_y']], 0.0, atol=1e-6)
    np.testing.assert_allclose([cell['cos2'], cell['sin2']], [1.0, 0.0], atol=1e-6)


def test_the_faces_of_a_thin_wall_are_kept_apart():
    """A wall of 10 cm between two rooms: each face points into the room of its observer."""
    wall = np.array([[-4.0, 0.02, 4.0, 0.02], [4.0, 0.12, -4.0, 0.12]])
    local_map = map_of(wall[:1], [np.array([x, -2.0, math.pi / 2.0]) for x in (-1.0, 0.0, 1.0)])
    for x in (-1.0, 0.0, 1.0):
        add_scan(local_map, wall[1:], np.array([x, 2.0, -math.pi / 2.0]))
    cells, top, _ = cells_of(local_map)
    for row, face in ((0, -1.0), (2, 1.0)):
        face_y = cells[row - top]['face_y']
        hit = cells[row - top]['hits'] > 0
        assert np.count_nonzero(hit) > 50
        np.testing.assert_allclose(face_y[hit], face, atol=1e-3)


def test_hits_and_traversals_are_counted():
    """A beam does not count as an observation of cells near its end, which it may graze."""
    local_map = LocalMap()
    add(local_map, np.array([[0.525, 0.025]]), (0.025, 0.025), 0.0)
    cells, top, left = cells_of(local_map)
    row = cells[-top]
    assert row['hits'][-left : 11 - left].tolist() == [0] * 10 + [1]
    assert row['seen'][-left : 11 - left].tolist() == [1] * 9 + [0, 1]
    assert cells['seen'].sum() == 10


def test_counts_forget_and_do_not_run_over():
    local_map = LocalMap()
    laser = np.array([0.025, 0.025])
    point = np.array([[1.025, 0.025]])
    for _ in range(600):
        add(local_map, point, laser, 0.0)
    cells, *_ = cells_of(local_map)
    assert 127 < cells['seen'].max() <= 255
    assert (cells['hits'] <= cells['seen']).all()
    assert wall_distances(local_map, point)[0] < 0.03
    beyond = np.array([[2.025, 0.025]])
    looks = 0
    while wall_distances(local_map, point)[0] < 0.1:
        add(local_map, beyond, laser, 0.0)
        looks += 1
    assert looks < 600, 'seen 600 times, forgotten sooner'


def test_a_cell_is_a_wall_while_enough_of_its_observations_are_hits():
    """One hit and three traversing beams: a hit ratio of a quarter is no wall."""
    local_map = LocalMap()
    point = np.array([[1.025, 0.025]])
    add(local_map, point, (0.025, 0.025), 0.0)
    for passes in range(4):
        is_wall = passes < 3
        assert bool(wall_distances(local_map, point)[0] < 0.01) is is_wall
        add(local_map, np.array([[2.025, 0.025]]), (0.025, 0.025), 0.0)
    cell = cell_at(local_map, 1.025, 0.025)
    assert (cell['hits'], cell['seen']) == (1, 5)
    add(local_map, point, (0.025, 0.025), 0.0)
    assert wall_distances(local_map, point)[0] < 0.01, 'it is one again'


@pytest.mark.parametrize('wall_m', [1.003, 1.013, 1.025, 1.041])
def test_distances_from_a_wall_are_finer_than_a_cell(wall_m):
    """To the mean of the hits of the nearest cell, which is on the wall within half a cell."""
    along = np.arange(-2.0, 2.0, 0.01) + 0.005
    local_map = LocalMap()
    add(local_map, np.column_stack([along, np.full(len(along), wall_m)]))
    x, away = np.meshgrid(np.linspace(-0.995, 1.0, 58), np.linspace(0.06, 0.4, 18))
    beside = (x / CELL_M - np.floor(x / CELL_M) - 0.5) * CELL_M
    for side in (-1.0, 1.0):
        points = np.column_stack([x.ravel(), wall_m + side * away.ravel()])
        found = wall_distances(local_map, points)
        np.testing.assert_allclose(found, np.hypot(away, beside).ravel(), atol=1e-6)


@pytest.mark.parametrize('angle', np.linspace(0.1, 1.4, 6))
def test_distances_from_a_slanted_noisy_wall(rng, angle):
    normal = np.array([math.cos(angle), math.sin(angle)])
    tangent = np.array([-normal[1], normal[0]])
    along = rng.uniform(-2.0, 2.0, 4000)
    local_map = LocalMap()
    wall = 2.0 * normal + along[:, None] * tangent
    add(local_map, wall + rng.normal(0.0, 0.005, (4000, 1)) * normal, angle_rad=angle)
    away = rng.uniform(0.1, 0.4, 300)
    points = (2.0 - away)[:, None] * normal + rng.uniform(-1.0, 1.0, (300, 1)) * tangent
    off = wall_distances(local_map, points) - away
    assert np.sqrt(np.mean(off**2)) < 0.01


def test_a_state_is_restored(rng):
    local_map = LocalMap()
    again = LocalMap()
    for pose in AROUND_BOX:
        add_scan(local_map, ROOM, pose - [8.0, 20.0, 0.0], rng)
        add_scan(local_map, ROOM, pose, rng)
    state = local_map.state()
    again.restore(snapshot.validate(state, FIELDS, 'local map'))
    assert set(state) == set(FIELDS)
    for name, array in state.items():
        assert np.any(array), name
        np.testing.assert_array_equal(again.state()[name], array)
    # A cell may refer to any of several equally near walls.
    for each in (local_map, again):
        cells, *_ = cells_of(each)
        np.testing.assert_array_equal(told(cells), nearest(cells))
    # Both continue identically.
    for each in (local_map, again):
        add_scan(each, ROOM, np.array([4.0, 7.0, 0.5]))
    for name, array in local_map.state().items():
        np.testing.assert_array_equal(again.state()[name], array)


def test_an_empty_state_is_restored():
    again = LocalMap()
    again.restore(LocalMap().state())
    assert again.is_empty


def test_cells_of_another_size_are_refused(rng):
    other = LocalMap(LocalMapConfig(resolution_m=0.1))
    add_scan(other, ROOM, AROUND_BOX[0], rng)
    with pytest.raises(InputError, match=r'cells of 0\.1 m.*expected 0\.05 m'):
        LocalMap().restore(other.state())


def test_a_tile_that_is_there_twice_is_refused(rng):
    local_map = LocalMap()
    add_scan(local_map, ROOM, AROUND_BOX[0], rng)
    state = {
        name: array if array.ndim == 0 else np.concatenate([array[:1], array[:1]])
        for name, array in local_map.state().items()
    }
    with pytest.raises(InputError, match='twice'):
        LocalMap().restore(state)


@pytest.mark.parametrize('normal', [(0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0)])
def test_walls_of_an_occupancy_map_are_added(normal):
    """One hit per cell, for any number of points in it, and no traversed cells."""
    normal = np.array(normal)
    along = np.abs(normal[::-1])
    points = np.arange(0.0, 3.0, 0.01)[:, None] * along + 2.02 * np.abs(normal)
    local_map = LocalMap()
    local_map.add_walls(points, normal)
    cells, *_ = cells_of(local_map)
    walls = cells[walls_of(cells)]
    assert cells['hits'].sum() == cells['seen'].sum() == len(walls) == 60
    np.testing.assert_array_equal(told(cells), nearest(cells))
    assert (wall_distances(local_map, points[50:-50]) < CELL_M).all()
    np.testing.assert_allclose(walls['cos2'], normal[0] ** 2 - normal[1] ** 2, atol=1e-6)
    np.testing.assert_allclose(walls['sin2'], 0.0, atol=1e-6)
    np.testing.assert_allclose(walls['face_x'], normal[0], atol=1e-6)
    np.testing.assert_allclose(walls['face_y'], normal[1], atol=1e-6)
    local_map.add_walls(np.empty((0, 2)), normal)
    assert cells_of(local_map)[0]['seen'].sum() == 60


def test_a_corridor_of_a_kilometre_is_mapped():
    local_map = LocalMap()
    for x in range(0, 1001, 20):
        walls = [[x - 15.0, 1.2, x + 15.0, 1.2], [x - 15.0, -1.2, x + 15.0, -1.2]]
        add_scan(local_map, np.array(walls), se2.pose(float(x), 0.0, 0.0))
    off = wall_distances(local_map, np.array([[1.0, 1.3], [501.0, 1.3], [1001.0, 1.3]]))
    np.testing.assert_allclose(off, 0.1, atol=0.03)


def test_an_empty_scan_changes_nothing(rng):
    local_map = LocalMap()
    local_map.add_scan(NOTHING, np.zeros(3), np.zeros(3))
    local_map.add_walls(np.empty((0, 2)), np.array([0.0, 1.0]))
    assert local_map.is_empty
    add_scan(local_map, ROOM, AROUND_BOX[0], rng)
    before = {name: array.copy() for name, array in local_map.state().items()}
    local_map.add_scan(NOTHING, np.zeros(3), np.array([1e3, 1e3, 0.0]))
    for name, array in local_map.state().items():
        np.testing.assert_array_equal(array, before[name])


def test_points_that_are_added_stay_as_they_are(rng):
    points = seen_in(ROOM, AROUND_BOX[0], rng)
    pose = AROUND_BOX[0]
    copies = points.copy(), pose.copy()
    LocalMap().add_scan(points, np.zeros(3), pose)
    np.testing.assert_array_equal(points, copies[0])
    np.testing.assert_array_equal(pose, copies[1])
    faces = np.column_stack([np.arange(0.0, 1.0, 0.01), np.ones(100)])
    copy = faces.copy()
    LocalMap().add_walls(faces, np.array([0.0, 1.0]))
    np.testing.assert_array_equal(faces, copy)


def test_far_from_all_tiles_there_is_no_wall(rng):
    far = np.array([[1e4, -1e4], [-500.0, 3.0], [5.0, 1e6]])
    local_map = LocalMap()
    np.testing.assert_array_equal(wall_distances(local_map, far), CELL_M * REACH)
    add_scan(local_map, ROOM, AROUND_BOX[0], rng)
    np.testing.assert_array_equal(wall_distances(local_map, far), CELL_M * REACH)
    assert wall_distances(local_map, np.empty((0, 2))).shape == (0,)


@pytest.mark.parametrize('corner', [(0, 0), (-1, -1), (3, -2)])
def test_walls_at_the_rim_of_a_tile_are_known_in_the_next(corner):
    """One point in each corner cell of a tile, observed from its centre."""
    edge_m = TILE * CELL_M
    low = edge_m * np.array(corner)
    inside = np.array([[0.02, 0.02], [0.02, -0.02], [-0.02, 0.02], [-0.02, -0.02]])
    points = low + inside % edge_m
    local_map = LocalMap()
    add(local_map, points, low + 0.5 * edge_m)
    cells, *_ = cells_of(local_map)
    np.testing.assert_array_equal(told(cells), nearest(cells))
    outwards = np.sign(points - low - 0.5 * edge_m) * [0.2, 0.2]
    expected = np.hypot(0.2, 0.2)
    np.testing.assert_allclose(wall_distances(local_map, points + outwards), expected, atol=0.015)


def test_only_tiles_along_the_beams_and_around_the_walls_take_memory():
    local_map = LocalMap()
    add(local_map, np.array([[30.0, 30.0]]))
    top, left, end_row, end_col = local_map.tiles.bounds()
    along = (end_row - top) // TILE
    assert along == (end_col - left) // TILE > 5
    assert along <= local_map.tiles.used < along**2 / 2


def test_a_scan_is_put_where_the_robot_is():
    T_base_laser = np.array([0.2, -0.1, 0.3])
    pose = np.array([3.0, 2.0, 1.0])
    points = seen_in(ROOM, pose)
    local_map = LocalMap()
    by_hand = LocalMap()
    local_map.add_scan(points, T_base_laser, pose)
    laser = se2.compose(pose, T_base_laser)
    points_map = points.copy()
    points_map[:, :2] = se2.transform_points(pose, points[:, :2])
    by_hand.add_scan(points_map, laser, np.zeros(3))
    for name in ('tiles', 'hits'):
        np.testing.assert_array_equal(local_map.state()[name], by_hand.state()[name])
    looked = local_map.state()['seen'].astype(int) - by_hand.state()['seen']
    assert np.count_nonzero(looked) < 0.01 * np.count_nonzero(by_hand.state()['seen'])
    assert wall_distances(local_map, points_map[:, :2]).max() < 1.5 * CELL_M


def test_kernels_are_what_they_are_in_plain_python(rng, monkeypatch):
    """The box appears and vanishes."""
    compiled = LocalMap()
    plain = LocalMap()
    scans = [
        (seen_in(segments, pose, rng)[::7], pose)
        for segments in (ROOM, WITHOUT_BOX, WITHOUT_BOX, WITHOUT_BOX)
        for pose in AROUND_BOX[:3]
    ]
    assert len(scans[0][0]) > 10
    for points, pose in scans:
        compiled.add_scan(np.ascontiguousarray(points), np.zeros(3), pose)
    for name in ('_touched', '_add', '_hit', '_appear', '_vanish'):
        monkeypatch.setattr(module, name, getattr(module, name).py_func)
    for points, pose in scans:
        plain.add_scan(np.ascontiguousarray(points), np.zeros(3), pose)
    ours, theirs = (cells_of(each)[0] for each in (compiled, plain))
    assert (ours['seen'] > 0).any()
    for name in ours.dtype.names:
        np.testing.assert_allclose(ours[name], theirs[name], atol=1e-6, err_msg=name)


@pytest.mark.parametrize(('row', 'col'), [(0, 0), (-7, 3), (TILE - 2, -TILE - 5)])
def test_free_cells_of_a_map_are_observed_and_no_others(row, col):
    rng = np.random.default_rng(row + 1000)
    free = rng.random((TILE + 9, 2 * TILE + 3)) < 0.3
    local_map = LocalMap()
    local_map.add_free_cells(free, row, col)
    height, width = free.shape
    cells = local_map.tiles.read(row - 5, col - 5, height + 10, width + 10)
    np.testing.assert_array_equal(cells['seen'] > 0, np.pad(free, 5))
    assert not cells['hits'].any()


def test_free_cells_keep_the_observations_and_walls_that_are_there():
    local_map = LocalMap()
    add_scan(local_map, ROOM, np.array([2.0, 2.0, 0.0]))
    before = local_map.tiles.read(0, 0, 2 * TILE, 2 * TILE).copy()
    local_map.add_free_cells(np.ones((2 * TILE, 2 * TILE), dtype=np.bool_), 0, 0)
    after = local_map.tiles.read(0, 0, 2 * TILE, 2 * TILE)
    np.testing.assert_array_equal(after['seen'], np.maximum(before['seen'], 1))
    np.testing.assert_array_equal(after['hits'], before['hits'])


def test_no_free_cells_leave_the_map_empty():
    local_map = LocalMap()
    local_map.add_free_cells(np.zeros((5, 5), dtype=np.bool_), 3, 3)
    assert local_map.is_empty
    assert local_map.tiles.used == LocalMap().tiles.used
