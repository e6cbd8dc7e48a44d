"""A localizer that resumes in an occupancy map: the map does not shift."""

import numpy as np
import pytest
from support.slam_room import ROOM, drive, scan_in, seen_in

from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.odometry import OdometryAnchor
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.matching.local_map import LocalMap
from thinmap_ros.core.slam.matching.scan_matcher import Matcher
from thinmap_ros.core.slam.matching.surface import free_cells, occupied_surface_points
from thinmap_ros.core.slam.track import LocalizerConfig

START = np.array([2.0, 2.0, 0.0])


def test_points_lie_on_the_faces_that_are_turned_to_free_cells():
    cells = np.full((9, 9), 100, dtype=np.int8)
    cells[2:7, 3:8] = 0
    cells[:, 8] = -1
    faces = occupied_surface_points(GridPatch(GridFrame(-1.0, 2.0, 0.1), cells))
    right, left, up, down = (face.points for face in faces)
    # The room's walls are at x = -0.7 (left of it) and y = 2.2 and 2.7; on its right nothing is
    # known.
    assert len(left) == 0
    np.testing.assert_allclose(right[:, 0], -0.7 - 0.02, atol=1e-9)
    np.testing.assert_allclose(up[:, 1], 2.2 - 0.02, atol=1e-9)
    np.testing.assert_allclose(down[:, 1], 2.7 + 0.02, atol=1e-9)
    assert right[:, 1].min() == pytest.approx(2.225)
    assert right[:, 1].max() == pytest.approx(2.675)
    np.testing.assert_allclose(np.diff(right[:, 1]), 0.05, atol=1e-9)


def test_normals_point_from_the_faces_to_free_cells():
    cells = np.full((9, 9), 100, dtype=np.int8)
    cells[2:7, 3:8] = 0
    patch = GridPatch(GridFrame(-1.0, 2.0, 0.1), cells)
    faces = occupied_surface_points(patch)
    assert len({tuple(face.normal) for face in faces}) == 4
    for points, normal in faces:
        assert len(points) == 10
        assert np.hypot(*normal) == 1.0
        for sign, free in ((1.0, True), (-1.0, False)):
            x, y = (points + sign * 0.05 * normal).T
            rows = np.floor((y - 2.0) / 0.1).astype(int)
            cols = np.floor((x + 1.0) / 0.1).astype(int)
            assert (patch.free[rows, cols] == free).all()


def test_faces_of_a_map_hold_a_robot_along_their_normals():
    """A scan matches the local map that is made of them."""
    cells = np.full((60, 80), 100, dtype=np.int8)
    cells[1:-1, 1:-1] = 0
    local_map = LocalMap()
    for points, normal in occupied_surface_points(GridPatch(GridFrame(0.0, 0.0, 0.1), cells)):
        local_map.add_walls(points, normal)
    faces = np.array([[0.08, 0.08], [7.92, 0.08], [7.92, 5.92], [0.08, 5.92]])
    walls = np.hstack([faces, np.roll(faces, -1, axis=0)])
    truth = np.array([3.0, 2.0, 0.6])
    prior = truth + [0.08, -0.06, 0.04]
    doubt = np.diag(np.square([0.1, 0.1, 0.1]))
    found = Matcher().match(seen_in(walls, truth), np.zeros(3), local_map, prior, doubt)
    assert found.inlier_ratio > 0.95
    assert np.hypot(*(found.pose - truth)[:2]) < 0.01
    assert abs(found.pose[2] - truth[2]) < 0.003


def test_a_map_without_walls_has_no_points():
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), np.zeros((5, 5), dtype=np.int8))
    assert all(len(faces.points) == 0 for faces in occupied_surface_points(patch))


@pytest.mark.parametrize('resolution', [0.03, 0.05, 0.1])
@pytest.mark.parametrize('origin', [(0.0, 0.0), (-1.234, 2.017)])
def test_free_cells_are_those_of_the_map_at_their_centres(resolution, origin):
    rng = np.random.default_rng(4)
    cells = rng.choice(np.array([-1, 0, 100], dtype=np.int8), (40, 50))
    patch = GridPatch(GridFrame(*origin, resolution), cells)
    free, row, col = free_cells(patch, 0.05)
    assert 0 < free.sum() < free.size
    size = np.array(free.shape) * 0.05
    np.testing.assert_allclose(size, np.array(cells.shape) * resolution, atol=0.05)
    for (i, j), is_free in np.ndenumerate(free):
        x = (col + j + 0.5) * 0.05 - origin[0]
        y = (row + i + 0.5) * 0.05 - origin[1]
        near_row = min(int(y / resolution + 1e-9), 39), min(int(y / resolution - 1e-9), 39)
        near_col = min(int(x / resolution + 1e-9), 49), min(int(x / resolution - 1e-9), 49)
        # A centre on an edge between two cells may count to either.
        assert is_free in patch.free[np.ix_(near_row, near_col)]


def killed(config, seed, resolution, slip):
    """Largest errors before the crash and after it, m; the last estimate."""
    rng = np.random.default_rng(seed)
    localizer = Localizer(config)
    last = None
    grid = OccupancyGrid(OccupancyConfig(resolution_m=resolution))
    off = se2.pose(slip[0], 0.0, slip[1])
    before = 0.0
    after = 0.0
    begin = np.zeros(3)
    for k, (truth, odom) in enumerate(drive(700, rng, START)):
        scan = scan_in(ROOM, truth, rng, k)
        if k < 400:
            estimate = localizer.step(scan, odom)
            grid.add_scan(scan, estimate.T_map_base)
            last = OdometryAnchor(k, estimate.T_map_odom, odom)
            before = max(before, float(np.hypot(*(estimate.T_map_base - truth)[:2])))
        elif k >= 450:
            begin = odom if k == 450 else begin
            slipped = se2.compose(se2.compose(begin, off), se2.between(begin, odom))
            if k == 450:
                localizer = Localizer.in_occupancy_map(grid.known_area(), config)
                localizer.resume(last, slipped)
            estimate = localizer.step(scan, slipped)
            after = max(after, float(np.hypot(*(estimate.T_map_base - truth)[:2])))
    return before, after, estimate


@pytest.mark.parametrize('resolution', [0.1, 0.05])
@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('slip', [(0.0, 0.0), (0.3, 0.2)])
def test_a_killed_localizer_does_not_bend_the_map(seed, resolution, slip):
    """After two metres of slip without a localizer the error is that of the map plus a cell."""
    config = LocalizerConfig(initial_x_m=2.0, initial_y_m=2.0)
    before, worst, estimate = killed(config, seed, resolution, slip)
    assert not estimate.is_lost
    assert worst < before + 0.05
    assert worst < 0.1
