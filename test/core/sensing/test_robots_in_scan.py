"""Beams that end at other robots."""

import math

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid
from thinmap_ros.core.scan import Scan

POSE = se2.pose(2.0, 3.0, 0.5 * math.pi)


def scan_of(ranges):
    return Scan.create(0, ranges, -0.2, 0.1, 0.05, 8.0)


def test_beams_at_a_robot_and_those_beside_them_are_invalid():
    scan = scan_of([5.0, 4.0, 1.8, 5.0, 5.0])
    cut = scan.without_places(POSE, np.array([[2.0, 5.0]]), 0.35)
    # The second beam is mixed of robot and wall.
    assert np.isnan(cut.ranges_m).tolist() == [False, True, True, True, False]
    assert not np.isnan(scan.ranges_m).any()


def test_the_first_beam_has_one_neighbour():
    x = 2.0 + 2.0 * math.sin(0.2)
    y = 3.0 + 2.0 * math.cos(0.2)
    cut = scan_of([2.0, 5.0, 5.0, 5.0, 5.0]).without_places(POSE, np.array([[x, y]]), 0.35)
    assert np.isnan(cut.ranges_m).tolist() == [True, True, False, False, False]


def test_nothing_is_cut_where_no_robot_is():
    scan = scan_of([5.0, np.inf, np.nan, 0.0, 5.0])
    assert scan.without_places(POSE, np.array([[2.0, 4.0]]), 0.35) is scan
    assert scan.without_places(POSE, np.empty((0, 2)), 0.35) is scan


def test_a_robot_leaves_no_wall_in_the_map():
    angles = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 181)
    off = np.abs(angles) < math.asin(0.22 / 2.0)
    ranges = np.where(off, 1.85, 4.0)
    scan = Scan.create(0, ranges, -0.5 * math.pi, math.pi / 180, 0.05, 8.0)
    walls = []
    for seen in (scan, scan.without_places(POSE, np.array([[2.0, 5.0]]), 0.35)):
        grid = OccupancyGrid(PAPER_GRID)
        for _ in range(3):
            grid.add_scan(seen, POSE)
        patch = grid.known_area()
        places = patch.frame.centres_of(np.argwhere(patch.occupied))
        walls.append(int((np.hypot(*(places - (2.0, 5.0)).T) < 0.5).sum()))
    assert walls[0] > 0
    assert walls[1] == 0
