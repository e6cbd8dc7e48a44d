"""Frontier candidates: assignment of frontiers to end nodes, and their viewpoints."""

import math

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.exploration.candidates import SurveyConfig, Surveyor
from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.raytrace import line_is_clear

FRAME = GridFrame(0.0, 0.0, 0.1)
AT = se2.pose(1.0, 2.0, 0.0)


def surveyor_of(cells, ends=None):
    surveyor = Surveyor(SurveyConfig())
    surveyor.borders.update(
        GridPatch(FRAME, cells.astype(np.int8)), np.array([[0.0, 0.0], [1.0, 1.0]])
    )
    surveyor.follow(ends or {})
    return surveyor


def corridor():
    """12 x 4 m between walls, known up to x = 9 m."""
    cells = np.full((40, 120), -1)
    cells[:, :90] = 0
    cells[[0, -1]] = 100
    cells[:, 0] = 100
    return cells


def corner():
    """A room of 4 x 4 m with a side room to the north, hidden behind the corner."""
    cells = np.full((90, 90), -1)
    cells[:40, :40] = 0
    cells[[0, 39], :40] = 100
    cells[:40, [0, 39]] = 100
    cells[39, 25:35] = 0
    for row in range(40, 80):
        cells[row, 25 + (row - 40) // 2 : 35 + (row - 40)] = 0
    cells[80, 25:] = 100
    cells[40:81, 76:] = 100
    return cells


def test_a_border_at_the_end_of_the_range_is_looked_at_from_a_little_nearer():
    (candidate,) = surveyor_of(corridor()).survey(AT, 8.0)
    assert candidate.track.node_id == FIRST_FRONTIER_ID
    assert len(candidate.cells) == 38
    # Cells 2 m behind the frontier at 9 m are in range from 3.5 m on.
    assert candidate.goal[0] == pytest.approx(11.0 - 7.5, abs=0.5)
    assert abs(candidate.goal[2]) < 0.3


def test_where_a_far_look_showed_nothing_the_robot_goes_to_the_node_and_then_to_the_border():
    surveyor = surveyor_of(corridor(), {5: (8.0, 2.0)})
    (far,) = surveyor.survey(AT, 8.0)
    assert far.track.node_id == 5
    assert far.goal[0] < 5.0
    surveyor.examined(far, far.goal)
    (near,) = surveyor.survey(AT, 8.0)
    assert near.track.node_id == 5
    assert near.goal[:2].tolist() == [8.0, 2.0]
    surveyor.examined(near, near.goal)
    (last,) = surveyor.survey(AT, 8.0)
    assert last.track.node_id >= FIRST_FRONTIER_ID
    assert last.goal[0] > 8.2
    surveyor.examined(last, last.goal)
    assert sum(len(c.cells) for c in surveyor.survey(AT, 8.0)) < len(last.cells)


def test_from_where_the_robot_is_to_look_most_of_what_is_hidden_is_in_sight():
    surveyor = surveyor_of(corner())
    candidates = surveyor.survey(AT, 8.0)
    assert candidates
    borders = surveyor.borders
    for candidate in candidates:
        row, col = (int(v) for v in borders.frame.cells_of(candidate.goal[None, :2])[0])
        assert surveyor.reached[row, col]
        seen = [
            line_is_clear(borders.passable, row, col, int(r), int(c)) for r, c in candidate.cells
        ]
        assert np.mean(seen) > 0.5


def open_hall(seen_to_m):
    """36 x 20 m, observed up to x: the frontier is as long as the hall is wide."""
    cells = np.full((200, 360), -1)
    cells[:, : int(10 * seen_to_m)] = 0
    cells[[0, -1]] = 100
    cells[:, 0] = 100
    return cells


def test_of_a_border_longer_than_the_laser_reaches_a_part_is_looked_at_from_the_nearest_place():
    """No viewpoint shows most of it; the goal is as far from it as the range allows."""
    surveyor = surveyor_of(open_hall(12.0))
    near = se2.pose(2.0, 4.0, 0.0)
    far = se2.pose(2.0, 16.0, 0.0)
    for at in (near, far):
        (candidate,) = surveyor.survey(at, 8.0)
        assert len(candidate.cells) == 198
        assert candidate.goal[0] < 9.0
        assert abs(candidate.goal[1] - at[1]) < 2.5


def test_a_goal_stays_good_as_long_as_enough_can_be_seen_from_it():
    surveyor = surveyor_of(open_hall(12.0))
    (candidate,) = surveyor.survey(se2.pose(2.0, 4.0, 0.0), 8.0)
    assert surveyor.still_shows(candidate, candidate.goal, 8.0)
    assert surveyor.still_shows(candidate, se2.pose(10.0, 14.0, 0.0), 8.0)
    for x, y in ((2.0, 10.0), (-3.0, 5.0), (20.0, 10.0), (0.1, 0.1)):
        assert not surveyor.still_shows(candidate, se2.pose(x, y, 0.0), 8.0)
    surveyor.examined(candidate, candidate.goal)
    assert not surveyor.still_shows(candidate, candidate.goal, 8.0)


def test_the_way_to_a_goal_is_that_over_the_grid():
    surveyor = surveyor_of(corridor())
    (candidate,) = surveyor.survey(AT, 8.0)
    assert surveyor.way_m(candidate.goal) == pytest.approx(
        math.dist(candidate.goal[:2], AT[:2]), rel=0.1, abs=0.2
    )
    assert surveyor.way_m(np.array([11.0, 2.0, 0.0])) == math.inf
    assert surveyor.way_m(np.array([-50.0, 2.0, 0.0])) == math.inf


def test_no_owner_holds_less_of_a_stretch_than_counts_as_a_border():
    surveyor = Surveyor(SurveyConfig())
    surveyor.borders.frame = GridFrame(0.0, 0.0, 0.1)
    owners = np.array([7] * 9 + [8] * 2 + [-1] * 6 + [8] * 3 + [9] * 2)
    numbers = np.array([1] * 17 + [2] * 5, dtype=np.int32)
    found = surveyor._without_scraps(owners, numbers)
    assert found.tolist() == [7] * 11 + [-1] * 6 + [8] * 5
    assert owners[9] == 8
