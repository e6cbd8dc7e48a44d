import numpy as np
import pytest
from support.ride import Ride

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.grid_search import path_collides
from thinmap_ros.core.planning.paths import route_band
from thinmap_ros.core.planning.wavefront import Obstacles, WavefrontConfig, find_path, plan
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import build

CONFIG = WavefrontConfig()
START = (2.0, 1.5)
GOAL = (43.0, 1.5)
SHORT_WAY = (22.0, 1.5)
LONG_WAY = (22.0, 10.5)


def ring():
    """Corridors around a block: 42 m along the lower one, 60 m along the upper one."""
    cells = np.full((120, 450), 100, dtype=np.int8)
    cells[6:24, 6:444] = 0
    cells[96:114, 6:444] = 0
    cells[6:114, 6:24] = 0
    cells[6:114, 426:444] = 0
    return GridPatch(GridFrame(0.0, 0.0, 0.1), cells)


def graph_of(patch):
    return build(patch, START, TopologyConfig())


def length(path):
    return float(np.hypot(*np.diff(path, axis=0).T).sum())


def along(band, obstacles=None):
    found = find_path(band.patch, START, GOAL, CONFIG, obstacles, band=band.cells)
    return None if found is None else found.points


def passes(path, place):
    return float(np.hypot(*(path - place).T).min()) < 1.0


def with_wall(patch):
    cells = patch.cells.copy()
    cells[6:24, 220:222] = 100
    return GridPatch(patch.frame, cells)


def test_the_path_is_the_wavefronts_and_only_part_of_the_map_is_searched():
    patch = ring()
    band = route_band(graph_of(patch), patch, START, GOAL, CONFIG)
    path = along(band)
    alone = plan(patch, START, GOAL, CONFIG)
    np.testing.assert_allclose(path[[0, -1]], [START, GOAL])
    assert length(path) == pytest.approx(length(alone), rel=0.01)
    assert not path_collides(patch, path, CONFIG.robot_radius_m)
    assert (band.cells & band.patch.free).sum() < 0.7 * patch.free.sum()
    assert passes(path, SHORT_WAY)


def test_from_the_rim_of_a_wide_hall_the_graph_is_reached():
    cells = np.full((400, 700), 100, dtype=np.int8)
    cells[10:390, 10:390] = 0
    cells[190:210, 390:690] = 0
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), cells)
    topology = graph_of(patch)
    start = (4.0, 20.0)
    goal = (66.0, 20.0)
    paths = np.concatenate([edge.path for edge in topology.edges.values()])
    assert np.hypot(*(paths - start).T).min() > 6.0
    band = route_band(topology, patch, start, goal, CONFIG)
    assert find_path(band.patch, start, goal, CONFIG, band=band.cells).is_exact


def test_an_edge_that_the_grid_contradicts_is_left_out():
    patch = ring()
    path = along(route_band(graph_of(patch), with_wall(patch), START, GOAL, CONFIG))
    assert passes(path, LONG_WAY)
    assert not passes(path, SHORT_WAY)


def test_an_edge_that_scan_points_contradict_is_left_out():
    patch = ring()
    across = np.column_stack([np.full(19, 22.0), np.linspace(0.6, 2.4, 19)])
    obstacles = Obstacles(across, 0.24)
    path = along(route_band(graph_of(patch), patch, START, GOAL, CONFIG, obstacles), obstacles)
    assert passes(path, LONG_WAY)


def test_without_a_route_there_is_no_band():
    patch = ring()
    whole = graph_of(patch)
    cut = TopologicalMap(whole.nodes.values(), [])
    assert route_band(TopologicalMap(), patch, START, GOAL, CONFIG) is None
    assert route_band(cut, patch, START, GOAL, CONFIG) is None
    assert route_band(whole, patch, START, (22.0, 6.0), CONFIG) is None  # in the block
    assert route_band(whole, patch, START, (99.0, 1.5), CONFIG) is None  # off the map


def test_a_route_between_parts_of_a_graph_does_not_exist():
    patch = ring()
    cells = patch.cells.copy()
    cells[:, 220:226] = 100
    halves = GridPatch(patch.frame, cells)
    topology = build(halves, None, TopologyConfig())
    assert len(topology.components()) == 2
    assert route_band(topology, patch, START, GOAL, CONFIG) is None


@pytest.mark.parametrize('topology', [None, TopologicalMap(), graph_of(ring())])
def test_the_navigator_reaches_a_distant_goal_with_any_graph(topology):
    ride = Ride(ring().cells, [*START, 0.0])
    ride.navigator.topology = topology
    states = ride.go((*GOAL, 0.0), seconds=300.0)
    assert states[-1].state == 'reached'
    assert ride.seconds < 230.0
    assert passes(np.array([ride.pose[:2]]), GOAL)


def test_the_navigator_plans_around_a_wall_that_is_not_in_the_map():
    patch = ring()
    ride = Ride(with_wall(patch).cells, [19.0, 1.5, 0.0], known=patch.cells)
    ride.navigator.topology = graph_of(patch)
    ride.navigator.set_goal(*GOAL, 0.0)
    while ride.seconds < 40.0 and not (
        ride.navigator.path is not None and passes(ride.navigator.path, LONG_WAY)
    ):
        ride.step()
    assert passes(ride.navigator.path, LONG_WAY)
    assert ride.nearest_m > 0.2
