"""Wall distances of a map: refinement of poses, and what a map says of a view."""

import math

import numpy as np
import pytest
from support.driven_pieces import driven_piece

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.places.views import LATTICE_M
from thinmap_ros.core.places.wall_field import WallField

NO_KEYFRAMES = np.empty((0, 2))


@pytest.fixture(scope='module')
def piece():
    return driven_piece(1, 1).piece


def test_a_pose_is_refined_from_nearby(piece, rng_seed=3):
    rng = np.random.default_rng(rng_seed)
    for view in piece.views[::4]:
        off = rng.uniform(-1.0, 1.0, 3) * (0.35, 0.35, 0.08)
        rough, fits = piece.field.refined_widely(view, (view.T_piece_view + off)[None])
        T, information, fit = piece.field.refined(view, rough[0])
        error = se2.between(view.T_piece_view, T)
        assert math.hypot(error[0], error[1]) < 0.06
        assert abs(error[2]) < 0.01
        assert np.linalg.eigvalsh(information).min() > 0.0
        assert 0.0 < fits[0] <= 1.0 and 0.5 < fit <= 1.0


def test_the_right_place_agrees_and_another_one_does_not(piece):
    for view in piece.views[::4]:
        found, known = piece.field.agreement(view, view.T_piece_view)
        assert found > 0.8
        assert known > 0.8
        turned = view.T_piece_view + (0.0, 0.0, 1.0)
        assert piece.field.agreement(view, turned)[0] < found - 0.2


def test_agreement_equals_a_slow_count(piece):
    """Cell by cell, in Python."""
    view = piece.views[3]
    patch = piece.patch
    T = view.T_piece_view + (0.7, -0.4, 0.3)
    field = WallField(patch, NO_KEYFRAMES)
    occupied = np.argwhere(patch.occupied)
    matched = contrary = blocked = 0
    for x, y in se2.transform_points(T, view.walls):
        row, col = patch.frame.cells_of(np.array([[x, y]]))[0]
        cells = np.hypot(*(occupied - (row, col)).T).min()
        inside = 0 <= row < patch.shape[0] and 0 <= col < patch.shape[1]
        if cells * patch.frame.resolution <= LATTICE_M + 1e-6:
            matched += 1
        elif inside and patch.free[row, col]:
            contrary += 1
    for x, y in se2.transform_points(T, view.free):
        row, col = patch.frame.cells_of(np.array([[x, y]]))[0]
        inside = 0 <= row < patch.shape[0] and 0 <= col < patch.shape[1]
        blocked += inside and patch.occupied[row, col]
    found, known = field.agreement(view, T)
    assert found == pytest.approx(matched / (matched + contrary + blocked))
    assert known == pytest.approx((matched + contrary) / len(view.walls))


def test_only_walls_near_keyframes_contradict(piece):
    """Farther walls were seen in part: the map is free where it is only less complete."""
    view = piece.views[3]
    poses = np.array([frame.T_map_base for frame in piece.keyframes])
    away = np.hypot(*(poses[:, :2] - view.T_piece_view[:2]).T)
    cells = piece.patch.cells.copy()
    cells[cells >= 65] = 0  # no wall was seen
    wall = piece.patch.occupied & (np.arange(piece.patch.shape[1]) < 3)
    cells[wall] = 100
    incomplete = GridPatch(piece.patch.frame, cells)
    near = WallField(incomplete, poses[:, :2])
    far = WallField(incomplete, poses[[int(away.argmax())], :2])
    assert near.agreement(view, view.T_piece_view)[1] > 0.8
    assert far.agreement(view, view.T_piece_view)[1] < 0.5


def test_random_poses_are_where_a_robot_may_stand(piece, rng_seed=4):
    poses = piece.field.random_poses(50, np.random.default_rng(rng_seed))
    rows, cols = piece.patch.frame.cells_of(poses[:, :2]).T
    assert piece.patch.free[rows, cols].all()
    assert len(np.unique(poses[:, 2])) > 40


def test_a_map_without_free_cells_has_no_place_to_stand():
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), np.full((20, 20), 100, dtype=np.int8))
    field = WallField(patch, NO_KEYFRAMES)
    assert field.random_poses(5, np.random.default_rng(0)).shape == (0, 3)
