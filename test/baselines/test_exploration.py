"""Baseline strategies: each finishes a small world, and chooses targets as documented."""

import math
from itertools import pairwise, permutations

import numpy as np
import pytest

from thinmap_ros.baselines.exploration import (
    BoundedTour,
    ExploreLite,
    Frontier,
    FrontierExplorer,
    InformationGain,
    NearestFrontier,
    VisitAllEndNodes,
    shortest_rest,
)
from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap
from thinmap_ros.evaluation.exploration_run import explore
from thinmap_ros.sim.world import World
from thinmap_ros.strategies import NAMES

START = np.array([1.0, 1.0, 0.0])


def two_rooms() -> World:
    cells = np.zeros((60, 90), dtype=np.uint8)
    cells[[0, -1]] = 1
    cells[:, [0, -1]] = 1
    cells[:25, 40:42] = 1
    cells[35:, 40:42] = 1
    cells[40:42, 60:] = 1
    return World('two_rooms', cells, GridFrame(0.0, 0.0, 0.1), START)


@pytest.mark.parametrize('strategy', sorted(set(NAMES) - {'paper'}))
def test_each_strategy_sees_all_stops_by_itself_and_touches_nothing(strategy: str) -> None:
    _, report = explore(
        two_rooms(), START, Options(strategy=strategy, speed_m_s=0.5, time_limit_s=600.0)
    )
    assert report['finished']
    assert report['coverage'] >= 0.99
    assert report['collisions'] == 0
    assert report['end_nodes_seen'] >= report['end_nodes_visited']


def test_the_literal_scheme_sets_out_and_stops_by_itself() -> None:
    _, report = explore(
        two_rooms(), START, Options(strategy='paper', speed_m_s=0.5, time_limit_s=600.0)
    )
    assert report['finished']
    assert report['distance'] > 1.0
    assert report['collisions'] == 0


def after_a_look(strategy: FrontierExplorer, cells: np.ndarray, pose: np.ndarray) -> list[Frontier]:
    """Frontiers of a map as the strategy finds them from a pose."""
    scan = Scan.create(0, np.full(181, np.nan), -math.pi / 2, math.pi / 180, 0.05, 8.0)
    strategy.finder.update(GridPatch(GridFrame(0.0, 0.0, 0.1), cells.astype(np.int8)), scan, pose)
    return strategy.finder.find(pose)


def corridor() -> np.ndarray:
    """A corridor of 16 m, open at both ends, with a wide opening in the upper side's right half."""
    cells = np.full((80, 160), -1)
    cells[30:50] = 0
    cells[29] = 100
    cells[50, :120] = 100
    cells[50:60, 120:150] = 0
    return cells


POSE = np.array([4.0, 4.0, 0.0])


def choice(strategy: FrontierExplorer) -> np.ndarray:
    frontiers = after_a_look(strategy, corridor(), POSE)
    assert len(frontiers) >= 2
    return np.asarray(frontiers[int(np.argmin(strategy.costs(frontiers, POSE)))].centroid)


def test_the_nearest_frontier_is_the_one_at_the_near_end() -> None:
    assert choice(NearestFrontier())[0] < 1.0


def test_explore_lite_and_information_gain_go_for_more_where_it_is_not_much_farther() -> None:
    near_the_middle = np.array([7.5, 4.0, 0.0])
    lite = ExploreLite()
    frontiers = after_a_look(lite, corridor(), near_the_middle)
    sizes = np.array([len(frontier.cells) for frontier in frontiers])
    equal = np.array([frontier.path_length_m for frontier in frontiers])
    costs = lite.costs(frontiers, near_the_middle)
    assert costs[sizes.argmax()] < costs[sizes.argmin()] + 0.3 * np.ptp(equal)
    gain = InformationGain()
    frontiers = after_a_look(gain, corridor(), near_the_middle)
    values = -gain.costs(frontiers, near_the_middle)
    assert (values > 0.0).all()


def test_a_failed_target_is_deferred_and_reported_at_the_end() -> None:
    strategy = NearestFrontier()
    pose = POSE
    scan = Scan.create(0, np.full(181, np.nan), -math.pi / 2, math.pi / 180, 0.05, 8.0)
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), corridor().astype(np.int8))
    topology = explore(two_rooms(), START, Options(time_limit_s=1.0))[0].pipeline.topology.map
    tried = []
    for i in range(40):
        decision = strategy.step(
            topology, patch, Scan.create(i * 10**9, scan.ranges_m, -1.57, 0.0174, 0.05, 8.0), pose
        )
        if decision.finished:
            break
        if decision.target is not None:
            tried.append(round(decision.target.x))
            strategy.target_failed('no way')
    assert decision.finished
    assert decision.reason == 'remaining targets are unreachable'
    assert tried[0] != tried[1]
    assert len(tried) >= 3 * len(set(tried))


def test_an_edge_is_followed_to_its_end_though_another_end_comes_nearer() -> None:
    def ends_at(x: float) -> TopologicalMap:
        places = [(x, 4.0), (14.0, 4.0)]
        nodes = [Node(k + 1, NodeKind.END, *place, 1.0) for k, place in enumerate(places)]
        path = np.array([[place[0], place[1]] for place in places])
        return TopologicalMap(nodes, [Edge(3, 1, 2, path, 14.0 - x, 1.0)])

    strategy = VisitAllEndNodes()
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), corridor().astype(np.int8))

    def goes_to(robot_x: float, end_x: float) -> float:
        scan = Scan.create(0, np.full(181, np.nan), -math.pi / 2, math.pi / 180, 0.05, 8.0)
        target = strategy.step(ends_at(end_x), patch, scan, np.array([robot_x, 4.0, 0.0])).target
        assert target is not None
        return target.x

    assert goes_to(7.9, 2.0) == 2.0
    # The frontier recedes: the other one is nearer now.
    assert [goes_to(7.9, x) for x in (1.8, 1.5, 1.3)] == pytest.approx([1.8, 1.5, 1.3], abs=0.35)
    # The robot has reached it.
    assert goes_to(1.2, 1.2) == 14.0


@pytest.mark.parametrize('kind', [ExploreLite, InformationGain, BoundedTour])
def test_targets_without_progress_are_given_up_also_by_a_robot_that_oscillates(
    kind: type[FrontierExplorer],
) -> None:
    strategy = kind()
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), corridor().astype(np.int8))
    places = []
    failed = []
    for second in range(120):
        # The cheaper target alternates, as when frontiers move.
        pose = np.array([7.0 if second % 2 else 9.0, 4.0, 0.0])
        scan = Scan.create(
            second * 10**9, np.full(181, np.nan), -math.pi / 2, math.pi / 180, 0.05, 8.0
        )
        target = strategy.step(TopologicalMap(), patch, scan, pose).target
        assert target is not None
        places.append(target.x)
        failed.append(len(strategy._failures))
    assert failed[20] == 0 < failed[-1]
    assert len(set(np.round(places, 1))) > 1


def test_an_end_node_that_comes_no_nearer_counts_as_visited() -> None:
    """A robot that never reaches its target, as if the frontier receded in a wide hall."""
    strategy = VisitAllEndNodes()
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), corridor().astype(np.int8))
    nodes = [Node(k + 1, NodeKind.END, x, 4.0, 1.0) for k, x in enumerate((2.0, 14.0))]
    path = np.array([[2.0, 4.0], [14.0, 4.0]])
    topology = TopologicalMap(nodes, [Edge(3, 1, 2, path, 12.0, 1.0)])
    targets = []
    for second in range(100):
        scan = Scan.create(
            second * 10**9, np.full(181, np.nan), -math.pi / 2, math.pi / 180, 0.05, 8.0
        )
        target = strategy.step(topology, patch, scan, np.array([7.0, 4.0, 0.0])).target
        assert target is not None
        targets.append(target.x)
    assert targets[:30] == [2.0] * 30
    assert targets[40:60] == [14.0] * 20
    assert targets[-1] not in (2.0, 14.0), 'frontiers that are left'


def test_who_drives_along_the_graph_goes_back_where_it_came_through() -> None:
    """A passage of two cells: too narrow for the other strategies once it is passed."""
    cells = corridor()
    cells[:, 60:62] = 100
    cells[39:41, 60:62] = 0
    far = np.array([8.0, 4.0, 0.0])
    passage = [np.array([x, 4.0, 0.0]) for x in np.arange(4.0, 8.0, 0.1)]
    middles = {}
    for strategy in (NearestFrontier(), VisitAllEndNodes()):
        for pose in passage:
            after_a_look(strategy, cells, pose)
        middles[type(strategy)] = [
            frontier.centroid[0] for frontier in after_a_look(strategy, cells, far)
        ]
    assert min(middles[NearestFrontier]) > 6.2
    assert min(middles[VisitAllEndNodes]) < 1.0


@pytest.mark.parametrize('count', [1, 2, 5, 6])
def test_the_bounded_tour_is_the_shortest_of_all_orders(count: int) -> None:
    places = np.random.default_rng(count).random((count, 2))
    between = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    expected = [
        min(
            sum(between[a, b] for a, b in pairwise((first, *order)))
            for order in permutations(set(range(count)) - {first})
        )
        for first in range(count)
    ]
    assert shortest_rest(between) == pytest.approx(expected)
