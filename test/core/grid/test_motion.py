"""A map that bends: each part moves as the pose nearest to it."""

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.moved import MapMotion, overlaid, overlaid_bent
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch


def corridor():
    """20 m long, 2 m wide, along the x axis."""
    cells = np.full((30, 210), UNKNOWN, dtype=np.int8)
    cells[5:25, 5:205] = 0
    cells[[5, 24], 5:205] = 100
    return GridPatch(GridFrame(-0.5, -1.5, 0.1), cells)


def test_points_move_as_the_pose_nearest_to_them_and_back():
    before = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    motion = MapMotion(before, np.array([[0.0, 0.0, 0.0], [10.0, 1.0, np.pi / 2.0]]))
    points = np.array([[1.0, 1.0], [11.0, 0.0]])
    moved = motion.moved(points)
    np.testing.assert_allclose(moved, [[1.0, 1.0], [10.0, 2.0]], atol=1e-9)
    np.testing.assert_array_equal(motion.nearest_after(moved), [0, 1])
    np.testing.assert_allclose(motion.undone(moved, np.array([0, 1])), points, atol=1e-9)


def test_a_corridor_that_is_bent_straight_has_no_gaps():
    along = np.arange(0.0, 20.0, 0.7)
    straight = np.column_stack([along, np.zeros_like(along), np.zeros_like(along)])
    arc = np.column_stack([along, 0.001 * along**2, 0.002 * along])
    there = MapMotion(straight, arc)
    empty = GridPatch(GridFrame(0.0, 0.0, 0.1), np.full((1, 1), UNKNOWN, dtype=np.int8))
    bent = overlaid_bent(empty, corridor(), there)
    back = overlaid_bent(empty, bent, MapMotion(arc, straight))
    middle = np.column_stack([np.arange(0.0, 19.0, 0.05), np.zeros(380)])
    rows, cols = back.frame.cells_of(middle).T
    assert (back.cells[rows, cols] == 0).all()
    for side in (-0.95, 0.95):
        rows, cols = back.frame.cells_of(middle + (0.0, side)).T
        walls = np.max([back.cells[rows + off, cols] for off in (-1, 0, 1)], axis=0)
        assert (walls == 100).all()


def test_poses_that_move_together_are_a_rigid_motion():
    T = se2.pose(3.0, -2.0, 0.3)
    before = np.array([[1.0, 0.0, 0.2], [8.0, 0.5, -0.1], [15.0, -0.5, 2.0]])
    after = np.array([se2.compose(T, own) for own in before])
    base = GridPatch(GridFrame(0.0, 0.0, 0.05), np.full((4, 4), UNKNOWN, dtype=np.int8))
    rigid = overlaid(base, corridor(), T)
    bent = overlaid_bent(base, corridor(), MapMotion(before, after))
    assert bent.frame == rigid.frame
    np.testing.assert_array_equal(bent.cells, rigid.cells)
