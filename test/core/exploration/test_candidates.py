"""Candidates: assignment of frontiers to end nodes, viewpoints, and what is kept."""

import math

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.exploration.belief import MAX_VISITS, WORTH_SEEING_M2
from thinmap_ros.core.exploration.candidates import CandidateConfig, CandidateFinder
from thinmap_ros.core.exploration.explorer import ExplorerConfig
from thinmap_ros.core.exploration.fitted import FITTED
from thinmap_ros.core.exploration.space import FrontierMap, is_enclosed, search_beside
from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID
from thinmap_ros.core.exploration.views import Sight, ViewFinder
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.planning.path_follower import SpeedConfig
from thinmap_ros.core.planning.travel_times import TravelTimes
from thinmap_ros.core.planning.wavefront import WavefrontConfig, plan
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.topology.graph import Node, NodeKind, TopologicalMap

FRAME = GridFrame(0.0, 0.0, 0.1)
AT = se2.pose(1.0, 2.0, 0.0)


class Room:
    """A map with its frontiers, and the candidates found in it."""

    def __init__(self, cells, ends=()):
        self.frontiers = FrontierMap()
        self.travel = TravelTimes(WavefrontConfig(), SpeedConfig(max_speed_m_s=0.5))
        self.sight = Sight()
        self.sight.add_scan(Scan.create(0, np.full(181, 4.0), -1.57, 0.0174, 0.05, 8.0))
        self.finder = CandidateFinder(CandidateConfig(), FITTED)
        self.nodes = [Node(5 + i, NodeKind.END, x, y, 1.0) for i, (x, y) in enumerate(ends)]
        self.set_cells(cells)

    def set_cells(self, cells):
        patch = GridPatch(FRAME, cells.astype(np.int8))
        self.frontiers.update(patch, np.array([[0.0, 0.0], [50.0, 50.0]]))

    def find(self, at=AT):
        frontiers = self.frontiers
        self.travel.update(frontiers.free, frontiers.passable, frontiers.frame, at)
        self.finder.update(TopologicalMap(self.nodes), frontiers, self.travel, self.sight)
        return self.finder.candidates


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


def open_hall(seen_to_m):
    """36 x 20 m, observed up to x: the frontier is as long as the hall is wide."""
    cells = np.full((200, 360), -1)
    cells[:, : int(10 * seen_to_m)] = 0
    cells[[0, -1]] = 100
    cells[:, 0] = 100
    return cells


def test_a_frontier_at_the_end_of_the_range_is_observed_from_a_little_nearer():
    (candidate,) = Room(corridor()).find()
    assert candidate.published(None).node_id == candidate.evidence.id == FIRST_FRONTIER_ID
    assert len(candidate.cells) == 38
    assert candidate.length_m == pytest.approx(3.8)
    # Cells 2 m behind the frontier at 9 m are in range from 3.5 m on.
    assert candidate.goal[0] == pytest.approx(11.0 - 7.5, abs=0.5)
    assert abs(candidate.goal[2]) < 0.3


def test_after_a_visit_without_success_a_frontier_is_observed_from_elsewhere():
    room = Room(corridor(), [(8.0, 2.0)])
    (far,) = room.find()
    assert far.node_id == 5
    assert far.goal[0] < 5.0
    far.evidence.add_visit((float(far.goal[0]), float(far.goal[1])))
    (other,) = room.find()
    assert other.evidence is far.evidence
    assert math.dist(other.goal[:2], far.goal[:2]) > 0.5
    assert other.probability > far.probability


def test_a_frontier_belongs_to_the_nearest_end_node_that_sees_it():
    room = Room(corridor(), [(6.5, 2.0), (8.0, 2.0), (8.5, 20.0)])
    (candidate,) = room.find()
    published = candidate.published(None)
    assert (published.node_id, published.x, published.y) == (6, 8.0, 2.0)
    assert len(candidate.cells) == 38
    assert published.probability == candidate.probability < 0.5
    settled = room.finder.settled
    assert [node.node_id for node in settled] == [5, 7]
    assert all(node.probability > 0.99 and node.expected_area_m2 == 0.0 for node in settled)
    cells = corridor()
    cells[1:38, 85] = 100
    room.set_cells(cells)
    own = [c for c in room.find() if c.node_id >= FIRST_FRONTIER_ID]
    assert sum(len(candidate.cells) for candidate in own) == 38
    assert [node.node_id for node in room.finder.settled] == [5, 6, 7]


def test_free_specks_behind_a_wall_are_no_candidates():
    cells = corridor()
    cells[1:39, 60] = 100
    cells[1:39, 61:] = -1
    assert Room(cells).find() == []
    # Beams that noise moved across the wall have left a line of free cells behind it.
    cells[5:25, 61] = 0
    room = Room(cells)
    for _ in range(2):
        assert room.find() == []
    # A hole in the wall: it may be worth a look.
    cells[10, 60] = 0
    room.set_cells(cells)
    (candidate,) = room.find()
    assert len(candidate.cells) == 20
    # So may a place that is cut off, but large enough for the robot.
    cells[10, 60] = 100
    cells[5:25, 61:71] = 0
    room.set_cells(cells)
    (candidate,) = room.find()
    assert candidate.goal is None


def test_most_of_what_is_hidden_is_in_line_of_sight_of_the_viewpoint():
    room = Room(corner())
    candidates = room.find()
    assert candidates
    frontiers = room.frontiers
    for candidate in candidates:
        row, col = (int(v) for v in frontiers.frame.cells_of(candidate.goal[None, :2])[0])
        assert np.isfinite(room.travel.seconds[row, col])
        seen = [
            line_is_clear(frontiers.passable, row, col, int(r), int(c)) for r, c in candidate.cells
        ]
        assert np.mean(seen) > 0.5


def test_a_frontier_longer_than_the_range_is_observed_in_part_from_the_nearest_place():
    room = Room(open_hall(12.0))
    for y in (4.0, 16.0):
        (candidate,) = room.find(se2.pose(2.0, y, 0.0))
        assert len(candidate.cells) == 198
        assert candidate.goal[0] < 9.5
        assert abs(candidate.goal[1] - y) < 2.5


def test_a_robot_without_a_wall_in_range_observes_a_frontier_from_where_one_is():
    """In the middle of a hall of 20 m, a laser of 8 m sees nothing that tells the place."""
    at = se2.pose(9.5, 10.0, 0.0)
    (candidate,) = Room(open_hall(12.0)).find(at)
    x, y = candidate.goal[:2].tolist()
    assert x > 8.0, 'not at the wall behind the robot'
    assert min(y, 20.0 - y) <= 7.2
    without_walls = open_hall(12.0)
    without_walls[[0, -1]] = without_walls[:, 0] = -1
    candidates = Room(without_walls).find(at)
    assert min(math.dist(each.goal[:2], at[:2]) for each in candidates) < 1.5


def test_a_robot_with_a_wall_in_range_observes_a_frontier_from_anywhere():
    (candidate,) = Room(open_hall(12.0)).find(se2.pose(2.0, 10.0, 0.0))
    x, y = candidate.goal[:2].tolist()
    assert min(x, y, 20.0 - y) > 8.0


def test_a_frontier_near_which_a_cell_changes_is_examined_at_once_and_the_others_in_turn():
    cells = open_hall(12.0)
    cells[95:105, 118:120] = 100
    room = Room(cells)
    room.find()
    finder = ViewFinder()

    def examine():
        clusters = room.frontiers.clusters(0.0)
        are_last = [False] * len(clusters)
        return finder.update(room.frontiers, room.travel, clusters, room.sight, are_last)

    first = examine()
    second = examine()
    third = examine()
    assert len(first) == 2
    assert [new is old for new, old in zip(second, first, strict=True)] == [False, True]
    assert [new is old for new, old in zip(third, second, strict=True)] == [True, False]
    cells[100, 60] = 100
    room.set_cells(cells)
    renewed = examine()
    assert all(new is not old for new, old in zip(renewed, third, strict=True))
    cells[105:, 120] = 0
    room.set_cells(cells)
    changed = examine()
    assert changed[-1] is not renewed[-1]


def test_a_change_beyond_a_wall_makes_no_frontier_worth_a_look():
    cells = np.full((60, 200), 100)
    cells[1:59, 1:80] = 0
    cells[1:59, 120:180] = 0
    cells[20:40, [80, 180]] = -1
    room = Room(cells)
    room.find()
    finder = ViewFinder()
    clusters = room.frontiers.clusters(0.0)
    are_last = [False] * len(clusters)
    finder.update(room.frontiers, room.travel, clusters, room.sight, are_last)
    # The one that was examined first is examined again now, and the other one the next time.
    before = finder.update(room.frontiers, room.travel, clusters, room.sight, are_last)
    cells[30, 150] = 100
    room.set_cells(cells)
    after = finder.update(room.frontiers, room.travel, clusters, room.sight, are_last)
    assert after[0] is before[0]


def test_the_last_visit_is_to_where_most_of_a_frontier_is_in_sight():
    room = Room(open_hall(12.0))
    at = se2.pose(2.0, 4.0, 0.0)
    (candidate,) = room.find(at)
    visited = (float(candidate.goal[0]), float(candidate.goal[1]))

    def share_in_sight():
        places = FRAME.centres_of(candidate.view.cells)
        areas_m2 = candidate.view.areas_m2
        is_new = np.hypot(*(places - visited).T) > 0.5
        away_m = np.hypot(*(places - candidate.goal[:2]).T)
        return areas_m2[away_m.argmin()] / areas_m2[is_new].max()

    assert share_in_sight() < 0.9
    candidate.evidence.add_visit(visited)
    (candidate,) = room.find(at)
    assert share_in_sight() < 0.9
    candidate.evidence.add_visit(visited)
    (candidate,) = room.find(at)
    assert share_in_sight() == 1.0


def test_more_places_are_examined_for_the_last_visit():
    """Only a few places see into a deep gap, and none of those that are examined first."""
    cells = np.full((60, 120), -1)
    cells[:21] = 0
    cells[[0, 20]] = 100
    cells[:21, [0, -1]] = 100
    cells[10:20, [59, 62]] = 100
    cells[20, 60:62] = 0
    room = Room(cells)
    at = se2.pose(10.0, 0.95, 0.0)
    (candidate,) = room.find(at)
    assert candidate.view.most_m2 == 0.0
    for _ in range(MAX_VISITS - 1):
        candidate.evidence.add_visit((candidate.goal[0], candidate.goal[1]))
    (candidate,) = room.find(at)
    assert candidate.view.most_m2 > WORTH_SEEING_M2
    place = FRAME.cells_of(candidate.goal[None, :2])[0]
    assert any(line_is_clear(cells == 0, *place, *cell) for cell in candidate.cells)


def test_a_short_frontier_counts_as_its_probability_says():
    """A gap of 0.3 m hides a room; one of 0.3 m in which a wall is seen hides nothing."""
    cells = np.full((60, 60), -1)
    cells[:40, :40] = 0
    cells[[0, 40], :41] = 100
    cells[:41, [0, 40]] = 100
    cells[40, 8:11] = -1
    cells[40, 28:31] = -1
    cells[41, 27:32] = 100
    wide, blind = sorted(Room(cells).find(), key=lambda candidate: candidate.probability)
    assert wide.length_m == pytest.approx(0.3)
    assert wide.middle[0] == pytest.approx(0.95)
    assert wide.probability < ExplorerConfig().probability_threshold < blind.probability


def test_a_gap_into_which_no_place_sees_hides_little():
    """Behind a pillar, close to a wall, nothing is seen: it hides what counts as something."""
    cells = corridor()
    cells[1:39, 60] = 100
    cells[1:39, 61:] = -1
    room = Room(cells)
    assert room.find() == [] and room.finder.missing.expected_m2 == 0.0
    cells[10, 60] = 0
    cells[8:13, 61] = 0
    cells[7:14, 62] = 100
    cells[[7, 13], 61] = -1
    room.set_cells(cells)
    room.find()
    assert 0.0 < room.finder.missing.expected_m2 < 0.5


def test_a_frontier_behind_a_passage_that_looks_too_narrow_is_observed_from_before_it():
    cells = np.full((40, 80), -1)
    cells[:, :40] = 0
    cells[[0, -1]] = 100
    cells[:, 0] = 100
    cells[:, 40] = 100
    cells[18:21, 40] = 0  # 0.3 m
    cells[15:25, 41:60] = 0
    cells[14, 41:60] = cells[25, 41:60] = 100
    room = Room(cells)
    for _ in range(2):
        candidates = [c for c in room.find() if c.length_m > 0.0]
        assert candidates
        for candidate in candidates:
            assert candidate.goal is not None
            assert candidate.goal[0] < 4.0
            assert candidate.area_m2 >= WORTH_SEEING_M2
            candidate.evidence.add_visit((float(candidate.goal[0]), float(candidate.goal[1])))


def cluttered(seed):
    """A hall of 16 x 8 m, known up to x = 13 m, with furniture a little too close for the robot."""
    rng = np.random.default_rng(seed)
    cells = np.full((80, 160), -1)
    cells[:, :130] = 0
    cells[[0, -1]] = 100
    cells[:, 0] = 100
    for row, col in rng.integers([2, 25], [76, 140], size=(70, 2)).tolist():
        cells[row : row + int(rng.integers(1, 9)), col : col + int(rng.integers(1, 9))] = 100
    return cells


def test_what_can_be_reached_is_what_the_navigator_finds_a_way_to():
    here = (float(AT[0]), float(AT[1]))
    config = WavefrontConfig(goal_search_radius_m=0.0)
    answers = set()
    for seed in range(8):
        cells = cluttered(seed)
        room = Room(cells)
        room.find()
        patch = GridPatch(FRAME, cells.astype(np.int8))
        rows, cols = np.nonzero(room.travel.traversable)
        for k in range(0, len(rows), 40):
            goal = FRAME.centres_of(np.array([[rows[k], cols[k]]]))[0].tolist()
            is_reachable = bool(room.travel.reachable[rows[k], cols[k]])
            assert is_reachable == (plan(patch, here, goal, config) is not None), (seed, goal)
            answers.add(is_reachable)
    assert answers == {True, False}


def test_no_place_is_visited_twice_and_a_place_that_can_be_reached_later_is_visited():
    """A room with a door of 0.3 m, too narrow for the robot, and a wide one that opens later."""
    cells = np.full((60, 120), -1)
    cells[:, :60] = 0
    cells[[0, -1]] = 100
    cells[:, 0] = 100
    cells[:, 60] = 100
    cells[18:21, 60] = 0
    cells[5:35, 61:75] = 0
    cells[4, 61:] = cells[35, 61:] = 100
    room = Room(cells)
    seen_from = []
    for _ in range(200):
        (candidate,) = (c for c in room.find() if c.length_m > 2.0)
        if candidate.goal is None:
            break
        assert all(math.dist(candidate.goal[:2], place) > 0.5 for place in seen_from)
        seen_from.append((float(candidate.goal[0]), float(candidate.goal[1])))
        candidate.evidence.add_visit(seen_from[-1])
    assert candidate.goal is None and not candidate.view.is_enclosed
    assert seen_from and all(x < 6.0 for x, _ in seen_from)
    cells[24:32, 60] = 0
    room.set_cells(cells)
    (candidate,) = (c for c in room.find() if c.length_m > 2.0)
    assert candidate.evidence.visits == len(seen_from)
    assert candidate.goal is not None


def test_no_place_is_beside_a_frontier_across_a_wall():
    free = np.zeros((40, 60), dtype=np.bool_)
    free[1:39, 1:59] = True
    free[:, 30] = False
    frontier = np.array([[20, 33], [21, 33]])
    allowed = free.copy()
    allowed[:, 31:] = False
    assert search_beside(free, frontier, allowed, 30, (20, 33)) is None
    assert is_enclosed(free, frontier, allowed)
    free[5, 30] = True
    place = search_beside(free, frontier, allowed, 30, (20, 33))
    assert place[1] < 30 and not is_enclosed(free, frontier, allowed)
    allowed[:, 25:] = False
    assert search_beside(free, frontier, allowed, 10, (20, 33)) is None
    assert not is_enclosed(free, frontier, allowed)
