"""The explorer in small worlds: coverage, termination with a reason, and hysteresis."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.belief import Evidence
from thinmap_ros.core.exploration.candidates import Candidate
from thinmap_ros.core.exploration.explorer import TURN_ID, Explorer, ExplorerConfig
from thinmap_ros.core.exploration.paper import PaperExplorer
from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID, Decision, FinishCode
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.navigator import Navigator, NavigatorConfig
from thinmap_ros.core.planning.path_follower import PathFollowerConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.core.topology.topology import TopologyBuilder
from thinmap_ros.sim.coverage import observable_cells
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.simulation import Simulation
from thinmap_ros.sim.world import World

START = np.array([1.0, 1.0, 0.0])


def world_of(walls=(), size=(60, 60)):
    """A closed floor with cells of 0.1 m, and inner walls given as (rows, cols) slices."""
    cells = np.zeros(size, dtype=np.uint8)
    cells[[0, -1]] = 1
    cells[:, [0, -1]] = 1
    for rows, cols in walls:
        cells[rows, cols] = 1
    return World('floor', cells, GridFrame(0.0, 0.0, 0.1), START)


def two_rooms():
    """A door of 1 m to a second room, in which a screen hides a corner."""
    return world_of([(slice(0, 25), 30), (slice(35, 60), 30), (slice(40, 42), slice(40, 60))])


class Run:
    """An exploration with known poses; fails(decision): whether navigation to a target fails."""

    def __init__(self, world, strategy=None, seed=1, fails=None, start=START, laser=None):
        self.world = world
        self.fails = fails or (lambda decision: False)
        self.simulation = Simulation(
            world, start, PRESETS['2dx'], laser or LaserScannerConfig(), seed
        )
        self.grid = OccupancyGrid(PAPER_GRID)
        self.topology = TopologyBuilder()
        self.explorer = strategy or Explorer()
        self.navigator = Navigator(
            NavigatorConfig(controller=PathFollowerConfig(max_speed_m_s=0.5))
        )
        self.decisions: list[Decision] = []
        self.poses: list[np.ndarray] = []
        self.scan = self.goal = None

    def look(self, scan):
        pose = self.simulation.robot.T_world_base
        self.grid.add_scan(scan, pose)
        self.topology.update(self.grid.window(pose[0], pose[1], 10.0), pose)
        decision = self.explorer.step(self.topology.map, self.grid.known_area(), scan, pose)
        self.decisions.append(decision)
        self.poses.append(pose)
        self.scan = scan
        if decision.target is None:
            self.navigator.cancel()
            self.goal = None
        elif self.fails(decision):
            self.explorer.target_failed('no way')
        elif self.goal is None or not np.array_equal(decision.target.goal, self.goal):
            self.goal = decision.target.goal
            self.navigator.set_goal(*map(float, self.goal))
        return decision

    def go(self, seconds=300.0):
        moment = self.simulation.read_sensors()
        while moment.stamp_ns < seconds * 1e9:
            if moment.scans and self.look(*moment.scans).finished:
                break
            command = self.navigator.step(
                self.simulation.robot.T_world_base, self.grid.known_area(), self.scan, 0.05
            )
            if command.state == 'failed':
                self.explorer.target_failed(command.reason)
            if command.state in ('reached', 'failed'):
                self.goal = None
            moment = self.simulation.step(command.v, command.w)
        return self

    @property
    def last(self):
        return self.decisions[-1]

    def coverage(self):
        return observable_cells(self.world, START, 0.22, 8.0).coverage(self.grid.known_area())


@cache
def finished_run():
    return Run(two_rooms()).go()


def test_it_sees_all_and_stops_by_itself_without_a_touch():
    run = finished_run()
    assert run.last.finished
    assert run.last.code == FinishCode.ALL_RESOLVED
    assert run.last.reason == 'all end nodes resolved'
    assert run.last.target is None
    assert run.coverage() >= 0.99
    assert run.simulation.robot.collisions == 0


def test_at_the_end_every_end_node_is_reliable():
    nodes = finished_run().last.end_nodes
    assert nodes
    assert (
        min(node.probability for node in nodes if node.node_id < FIRST_FRONTIER_ID)
        >= ExplorerConfig().probability_threshold
    )


def test_what_is_told_is_told_consistently():
    for decision in finished_run().decisions:
        targets = [node for node in decision.end_nodes if node.is_target]
        assert (targets == []) if decision.target is None else (targets == [decision.target])
        assert 0.0 <= decision.coverage_estimate <= 1.0
        assert len({node.node_id for node in decision.end_nodes}) == len(decision.end_nodes)
    areas = [decision.known_area_m2 for decision in finished_run().decisions]
    assert areas[-1] == pytest.approx(33.0, abs=2.0)
    assert finished_run().last.coverage_estimate > 0.98
    assert finished_run().last.remaining == 0
    expected_m2 = [decision.missing.expected_m2 for decision in finished_run().decisions]
    assert max(expected_m2) > 10.0 > 0.5 > expected_m2[-1]


def test_some_end_nodes_are_never_visited():
    run = finished_run()
    nodes = [node for node in run.last.end_nodes if node.node_id < FIRST_FRONTIER_ID]
    poses = np.array(run.poses)
    nearest = [np.hypot(poses[:, 0] - node.x, poses[:, 1] - node.y).min() for node in nodes]
    assert max(nearest) > 0.5


def test_it_decides_the_same_every_time():
    again = Run(two_rooms()).go()
    assert len(again.decisions) == len(finished_run().decisions)
    assert np.array_equal(np.array(again.poses), np.array(finished_run().poses))


def comb(doors=45):
    """A corridor with many openings to unknown space."""
    cells = np.full((60, 30 + 20 * doors), -1, dtype=np.int8)
    cells[[9, 50], :] = 100
    cells[10:50, :] = 0
    cells[10:50, [0, -1]] = 100
    for door in range(doors):
        cells[50, 20 + 20 * door : 30 + 20 * door] = 0
    return GridPatch(GridFrame(0.0, 0.0, 0.1), cells)


def niches(count, depth):
    """A corridor with openings to niches, unknown inside, in front of a wall that is known."""
    cells = np.full((60, 30 + 20 * count), -1, dtype=np.int8)
    cells[[9, 30], :] = 100
    cells[10:30, :] = 0
    cells[10:30, [0, -1]] = 100
    for niche in range(count):
        cells[30, 20 + 20 * niche : 30 + 20 * niche] = 0
        cells[31 + depth, 15 + 20 * niche : 35 + 20 * niche] = 100
    return GridPatch(GridFrame(0.0, 0.0, 0.1), cells)


@pytest.mark.parametrize('depth', [2, 3, 4])
@pytest.mark.parametrize('count', [1, 4, 12, 30])
def test_all_is_never_said_to_be_resolved_where_much_is_expected_to_be_missing(count, depth):
    explorer = Explorer()
    scan = Scan.create(0, np.full(181, np.inf), -math.pi / 2, math.pi / 180, 0.02, 3.0)
    for second in range(200):
        decision = explorer.step(
            TopologicalMap(),
            niches(count, depth),
            replace(scan, stamp_ns=second * 1_000_000_000),
            np.array([2.0, 2.0, 0.0]),
        )
        if decision.finished:
            break
        explorer.target_failed('no path')
    # Without what no visit shows: fringes before walls.
    expected_m2 = sum(candidate.expected_area_m2 for candidate in explorer.candidates)
    assert decision.finished and len(explorer.candidates) == count
    assert all(c.probability >= explorer.config.probability_threshold for c in explorer.candidates)
    assert (decision.code == FinishCode.ALL_RESOLVED) == (expected_m2 <= 2.0), expected_m2


@pytest.mark.parametrize('seed', range(4))
def test_at_the_end_of_small_worlds_little_is_missing_or_something_is_left(seed):
    rng = np.random.default_rng(seed)
    walls = [(slice(0, 25), 30), (slice(35, 60), 30)]
    for _ in range(6):
        row, col = rng.integers(8, 50, 2)
        long = int(rng.integers(3, 9))
        walls.append((slice(row, row + 1), slice(col, col + long)))
        walls.append((slice(row, row + long), slice(col, col + 1)))
    last = Run(world_of(walls), seed=seed, start=np.array([0.5, 0.5, 0.8])).go().last
    assert last.finished
    assert last.code == FinishCode.UNREACHABLE or last.missing.expected_m2 <= 2.0


def test_of_many_places_the_target_is_a_near_one_and_stays():
    explorer = Explorer()
    scan = Scan.create(0, np.full(181, np.inf), -math.pi / 2, math.pi / 180, 0.02, 3.0)
    targets = []
    for k in range(12):
        pose = np.array([50.0 + 0.1 * k, 2.0, math.pi / 2])
        decision = explorer.step(
            TopologicalMap(), comb(), replace(scan, stamp_ns=k * 400_000_000), pose
        )
        targets.append(decision.target)
    assert sum(node.frontier_length_m > 0.0 for node in decision.end_nodes) == 45
    assert math.dist(targets[0].goal[:2], (50.0, 2.0)) < 4.0
    assert len({target.node_id for target in targets}) == 1


def test_a_target_that_cannot_be_reached_is_put_aside_tried_again_and_named_at_the_end():
    refused = []

    def refuse(decision):
        refused.append(decision.target.node_id)
        return True

    run = Run(two_rooms(), fails=refuse).go(60.0)
    assert run.last.finished
    assert run.last.code == FinishCode.UNREACHABLE
    left = len(run.last.unreachable)
    assert left == run.last.remaining > 0
    assert run.last.reason == (
        f'{left} end node{"s" * (left > 1)} left, which the robot cannot reach or see into'
    )
    assert max(refused.count(node_id) for node_id in run.last.unreachable) >= 2
    assert not np.hypot(*(np.array(run.poses)[:, :2] - START[:2]).T).any()


def ajar():
    """A door of 0.3 m, too narrow for the robot, to a second room."""
    return world_of([(slice(0, 28), 30), (slice(31, 60), 30)])


@pytest.mark.parametrize('strategy', [Explorer, PaperExplorer])
def test_what_was_visited_in_vain_is_left_and_named(strategy):
    run = Run(ajar(), strategy()).go()
    assert run.last.finished
    given_up = [
        node
        for node in run.last.end_nodes
        if node.probability < ExplorerConfig().probability_threshold
    ]
    assert len(given_up) == run.last.remaining == len(run.last.unreachable)
    is_left = run.last.code == FinishCode.UNREACHABLE
    assert is_left == bool(given_up)
    assert ('which the robot cannot reach or see into' in run.last.reason) == is_left
    if strategy is Explorer:
        assert given_up


@pytest.mark.parametrize(
    ('field_of_view_deg', 'gap_m'), [(180.0, 0.24), (180.0, 0.3), (60.0, 0.24)]
)
def test_a_robot_in_front_of_a_wall_turns_and_explores(field_of_view_deg, gap_m):
    start = np.array([0.1 + gap_m, 1.0, math.pi])
    laser = LaserScannerConfig(beams=91, field_of_view_deg=field_of_view_deg)
    run = Run(two_rooms(), start=start, laser=laser).go()
    first = next(decision for decision in run.decisions if decision.target is not None)
    assert first.target.node_id == TURN_ID
    assert first.target in first.end_nodes
    assert run.last.code == FinishCode.ALL_RESOLVED
    assert run.coverage() > 0.98


def test_a_robot_that_cannot_turn_gives_up_with_what_it_does_not_see():
    laser = LaserScannerConfig(beams=91, field_of_view_deg=60.0)
    start = np.array([0.34, 1.0, math.pi])
    run = Run(two_rooms(), start=start, laser=laser, fails=lambda decision: True).go(60.0)
    assert run.last.finished and run.last.code == FinishCode.UNREACHABLE
    assert run.last.reason == '1 end node left, which the robot cannot reach or see into'
    turns = [d for d in run.decisions if d.target is not None and d.target.node_id == TURN_ID]
    assert len(turns) == 1


def test_a_navigator_that_refuses_all_goals_at_first_does_not_end_the_exploration():
    run = Run(two_rooms())
    run.fails = lambda decision: run.scan.stamp_ns < 30e9
    run.go()
    assert run.last.code == FinishCode.ALL_RESOLVED
    assert run.coverage() > 0.98


def test_a_belief_that_is_kept_is_that_of_its_evidence():
    run = Run(two_rooms())
    finder = run.explorer._finder

    def check(decision):
        own = {node.node_id: node for node in decision.end_nodes}
        for candidate in finder.candidates:
            published = own[candidate.node_id]
            expected = finder._model.probability(
                candidate.length_m,
                candidate.view.hidden_m2,
                candidate.view.depth_m,
                candidate.evidence.visits,
            )
            assert candidate.probability == published.probability == expected
        return False

    run.fails = check
    run.go()
    assert run.last.finished


def test_an_exploration_goes_on_from_its_state_as_if_it_had_not_been_interrupted():
    run = Run(two_rooms()).go(8.0)
    state = {key: array.copy() for key, array in run.explorer.state().items()}
    again = Explorer.from_state(state)
    assert {name: array.tolist() for name, array in again.state().items()} == {
        name: array.tolist() for name, array in state.items()
    }
    run.explorer = again
    run.go(300.0)
    assert run.last.finished
    assert run.last.code == FinishCode.ALL_RESOLVED
    assert run.coverage() >= 0.99
    late = Explorer.from_state(run.explorer.state())
    for k in range(3):
        scan = replace(run.scan, stamp_ns=run.scan.stamp_ns + k * 1_000_000_000)
        decision = late.step(run.topology.map, run.grid.known_area(), scan, run.poses[-1])
    assert decision.finished, 'a target that was visited without success stays visited'


@pytest.mark.parametrize('broken', ['ids', 'cells', 'visits'])
def test_a_state_that_is_none_is_refused(broken):
    state = Run(two_rooms()).go(1.0).explorer.state()
    with pytest.raises(InputError, match='saved exploration'):
        Explorer.from_state({key: array for key, array in state.items() if key != broken})


def test_the_scheme_of_the_paper_stops_by_itself_too():
    run = Run(two_rooms(), PaperExplorer()).go(600.0)
    assert run.last.finished
    assert run.simulation.robot.collisions == 0


def test_the_first_target_of_the_paper_is_the_one_that_the_robot_faces():
    run = Run(two_rooms(), PaperExplorer(), start=se2.pose(1.0, 1.0, 1.5)).go(3.0)
    first = next(decision for decision in run.decisions if decision.target is not None)
    turns = {
        node.node_id: abs(se2.wrap(math.atan2(node.y - 1.0, node.x - 1.0) - 1.5))
        for node in first.end_nodes
        if node.probability < ExplorerConfig().probability_threshold
    }
    assert turns[first.target.node_id] == min(turns.values())


def test_a_graph_that_is_there_before_the_map_does_not_end_the_exploration():
    run = Run(two_rooms())
    run.look(*run.simulation.read_sensors().scans)
    for _ in range(5):
        run.look(*run.simulation.step(0.0, 0.0).scans or [run.scan])
    assert run.topology.map.nodes
    unknown = GridPatch(
        run.grid.known_area().frame, np.full(run.grid.known_area().shape, -1, dtype=np.int8)
    )
    late = Explorer()
    for _ in range(20):
        decision = late.step(run.topology.map, unknown, run.scan, START)
        assert not decision.finished and decision.target is None
    assert late.step(run.topology.map, run.grid.known_area(), run.scan, START).known_area_m2 > 0.0


def test_of_two_viewpoints_that_take_turns_with_the_robot_one_is_reached():
    explorer = Explorer()
    evidence = Evidence(FIRST_FRONTIER_ID, (2.0, 2.0))
    cells = np.zeros((15, 2), dtype=np.int64)
    viewpoints = [se2.pose(0.0, 0.0, 0.5), se2.pose(0.0, 0.6, 0.5)]

    def goal_after(viewpoint, robot, middle=(2.0, 2.0)):
        candidate = Candidate(evidence, cells, middle)
        candidate.goal = viewpoint
        explorer._drive_to(candidate, robot)
        return explorer._target.goal

    assert goal_after(viewpoints[0], START) is viewpoints[0]
    assert goal_after(viewpoints[1], se2.pose(0.0, 0.2, 0.0)) is viewpoints[0]
    # A frontier that has moved is observed from where it can be seen now.
    assert goal_after(viewpoints[1], se2.pose(0.0, 0.2, 0.0), (2.1, 2.0)) is viewpoints[1]


def test_a_path_that_has_become_longer_is_a_new_decision():
    explorer = Explorer()
    near, far = (
        Candidate(
            Evidence(FIRST_FRONTIER_ID + i, (x, 0.0)),
            np.zeros((15, 2), dtype=np.int64),
            (x, 0.0),
            goal=se2.pose(x, 0.0, 0.0),
        )
        for i, x in enumerate((5.0, -20.0))
    )
    explorer._finder.candidates = [near, far]

    def choose():
        near.seconds = 10.0
        far.seconds = 40.0
        explorer._choose(TopologicalMap(), START)
        return explorer._target.candidate

    assert choose() is near
    explorer.path_grew(4.0)  # 20 s at 0.2 m/s
    assert choose() is near
    explorer.path_grew(20.0)
    assert choose() is far


def test_a_drive_that_failed_is_made_again_only_for_an_area_worth_seeing():
    explorer = Explorer()
    candidate = Candidate(
        Evidence(FIRST_FRONTIER_ID, (5.0, 0.0), failures=1),
        np.zeros((15, 2), dtype=np.int64),
        (5.0, 0.0),
        goal=se2.pose(5.0, 0.0, 0.0),
        seconds=10.0,
        probability=0.5,
    )
    explorer._finder.candidates = [candidate]
    explorer._now_ns = 100 * SECOND_NS
    for area_m2, is_target in ((0.8, False), (1.2, True)):
        candidate.area_m2 = area_m2
        explorer._choose(TopologicalMap(), START)
        assert (explorer._target.candidate is candidate) == is_target


def test_a_target_that_was_left_is_taken_again_for_a_larger_saving_only():
    """Two costs that take turns with the place of the robot end in one target."""
    explorer = Explorer()
    candidates = [
        Candidate(
            Evidence(FIRST_FRONTIER_ID + i, (x, 0.0)),
            np.zeros((15, 2), dtype=np.int64),
            (x, 0.0),
            goal=se2.pose(0.9 * x, 0.0, 0.0),
        )
        for i, x in enumerate((-50.0, 50.0))
    ]
    explorer._finder.candidates = candidates
    explorer.frontier_map.free_cells = 10  # of 1 m2
    changes = 0
    chosen = None
    for turn in range(40):
        # Each time the other one is reached 30 s sooner.
        candidates[turn % 2].seconds = 70.0
        candidates[1 - turn % 2].seconds = 100.0
        explorer._choose(TopologicalMap(), START)
        changes += explorer._target.candidate is not chosen
        chosen = explorer._target.candidate
    # After the first choice for a saving of 4, 8, 8, 16 and 16 s; 32 s are too much.
    assert changes == 6
    # Once something new was seen, the costs may be others.
    explorer.frontier_map.free_cells += 1
    for candidate in candidates:
        candidate.seconds = 100.0 if candidate is chosen else 70.0
    explorer._choose(TopologicalMap(), START)
    assert explorer._target.candidate is not chosen


def test_a_target_that_comes_and_goes_with_the_heading_does_not_hold_up_the_robot():
    """Each time that the robot turns to it, the place to see it from is gone."""
    explorer = Explorer()
    far, near = (
        Candidate(
            Evidence(FIRST_FRONTIER_ID + i, (x, 0.0)),
            np.zeros((15, 2), dtype=np.int64),
            (x, 0.0),
            goal=se2.pose(0.9 * x, 0.0, 0.0),
            seconds=seconds,
        )
        for i, (x, seconds) in enumerate(((-10.0, 18.0), (5.0, 10.0)))
    )
    explorer.frontier_map.free_cells = 10
    chosen = []
    for turn in range(8):
        explorer._finder.candidates = [far, near] if turn % 2 else [far]
        explorer._choose(TopologicalMap(), START)
        chosen.append(explorer._target.candidate)
    assert chosen[:4] == [far, near, far, far]
    assert chosen[4:] == [far] * 4


def test_after_a_visit_or_a_failure_the_next_viewpoint_counts():
    explorer = Explorer()
    evidence = Evidence(FIRST_FRONTIER_ID, (2.0, 2.0))
    candidate = Candidate(evidence, np.zeros((15, 2), dtype=np.int64), (2.0, 2.0))
    candidate.goal = se2.pose(0.0, 0.0, 0.5)
    explorer._drive_to(candidate, START)
    for _ in range(3):
        explorer._add_visit(se2.pose(0.0, 0.0, 0.5))
    assert evidence.visits == 1
    candidate.goal = se2.pose(0.5, 0.0, 0.5)
    explorer._drive_to(candidate, se2.pose(0.0, 0.0, 0.5))
    assert explorer._target.goal is candidate.goal
    explorer.target_failed('no path')
    assert evidence.failures == 1
    assert explorer._target.goal is None
    explorer._drive_to(candidate, START)
    for _ in range(3):
        explorer._add_visit(candidate.goal)
    assert (evidence.visits, evidence.failures) == (2, 0)
