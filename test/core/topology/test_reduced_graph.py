"""Graphs of saved maps: few nodes, straight edges, nothing that is not there."""

import itertools
import math
from pathlib import Path

import networkx
import numpy as np
import pytest

from benchmarks.graphs.graph_metrics import completeness, drivable_share
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.topology import routes
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.routes import EditedGraph, is_drivable, route_graph
from thinmap_ros.core.topology.thinning import select_free_space
from thinmap_ros.core.topology.topology import build_along
from thinmap_ros.files.occupancy_maps import read_map

CONFIG = TopologyConfig(max_unknown_gap_m=0.0)


def patch_of(cells: np.ndarray) -> GridPatch:
    return GridPatch(GridFrame(0.0, 0.0, 0.1), cells.astype(np.int8))


def room(rows: int, cols: int) -> np.ndarray:
    cells = np.zeros((rows, cols))
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    return cells


def graphs_of(
    cells: np.ndarray, node_spacing_m: float | None = None
) -> tuple[TopologicalMap, TopologicalMap]:
    """The whole skeleton of a map, and the reduced graph."""
    patch = patch_of(cells)
    standing = select_free_space(patch, None, CONFIG)
    whole = build_along(patch, standing, None, CONFIG)
    before = (dict(whole.nodes), dict(whole.edges))
    reduced = route_graph(whole, patch, standing, CONFIG, node_spacing_m=node_spacing_m)
    assert before == (whole.nodes, whole.edges)
    assert drivable_share(patch, reduced, CONFIG.robot_radius_m) == 1.0
    return whole, reduced


def rough_corridor() -> np.ndarray:
    cells = np.full((40, 300), 100)
    cells[8:32, 5:295] = 0
    rng = np.random.default_rng(3)
    for col in range(5, 295):
        cells[8 : 8 + rng.integers(0, 7), col] = 100
        cells[32 - rng.integers(0, 7) : 32, col] = 100
    return cells


def chairs() -> np.ndarray:
    """A room of 8 m x 8 m with 30 chair legs, and a corridor along it."""
    cells = np.full((130, 100), 100)
    cells[5:85, 5:85] = 0
    cells[100:120, 5:95] = 0
    cells[85:100, 40:52] = 0
    legs = np.random.default_rng(1).integers(15, 75, (30, 2))
    cells[legs[:, 0], legs[:, 1]] = 100
    return cells


def test_a_corridor_with_rough_walls_is_a_line() -> None:
    whole, reduced = graphs_of(rough_corridor(), 3.0)
    assert len(whole.nodes) > 2
    assert len(reduced.nodes) <= 4
    assert len(reduced.components()) == 1
    kinds = sorted(node.kind for node in reduced.nodes.values())
    assert kinds == [NodeKind.END, NodeKind.END] + [NodeKind.CORNER] * (len(kinds) - 2)


def test_a_room_with_chairs_is_no_thicket() -> None:
    whole, reduced = graphs_of(chairs())
    assert len(reduced.nodes) < 0.4 * len(whole.nodes)
    assert len(reduced.components()) == len(whole.components()) == 1


@pytest.mark.parametrize(('side', 'paths'), [(4, 1), (30, 2)])
def test_both_paths_round_an_obstacle_smaller_than_a_table_are_one(side: int, paths: int) -> None:
    cells = np.full((120, 120), 100)
    cells[5:115, 5:115] = 0
    # Corridors 2 m wide meet at an obstacle in the middle of a crossing.
    cells[5:35, 5:35] = cells[5:35, 85:115] = cells[85:115, 5:35] = cells[85:115, 85:115] = 100
    low = 60 - side // 2
    cells[low : low + side, low : low + side] = 100
    _, reduced = graphs_of(cells, 2.0)
    loops = len(reduced.edges) - len(reduced.nodes) + len(reduced.components())
    assert loops == paths - 1


def test_the_wider_path_stays() -> None:
    cells = room(60, 140)
    cells[26:34, 66:74] = 100
    cells[34:50, 66:74] = 0
    cells[50:59, 40:100] = 100
    _, reduced = graphs_of(cells)
    beside = [edge.path[np.abs(edge.path[:, 0] - 7.0) < 0.3, 1] for edge in reduced.edges.values()]
    heights = np.concatenate(beside)
    assert len(heights)
    assert (heights < 2.6).all()


def test_there_is_no_branch_into_rays_through_glass() -> None:
    cells = np.full((160, 200), -1)
    cells[19:41, 4:196] = 100
    cells[20:40, 5:195] = 0
    cells[40, 94:106] = 0  # a window
    rows, cols = np.mgrid[:160, :200]
    angle = np.degrees(np.arctan2(rows - 25, cols - 100))
    # Dense near the window, single rays farther off.
    is_ray = (np.abs(angle - 90) < 25) & (np.floor(angle) % 3 != 0) & (rows > 40)
    cells[is_ray & (rows < 120)] = 0
    cells[(rows > 40) & (rows < 75) & (np.abs(angle - 90) < 25)] = 0
    whole, reduced = graphs_of(cells)
    assert max(node.y for node in whole.nodes.values()) > 5.0
    assert max(node.y for node in reduced.nodes.values()) < 4.2


def rooms_of(share: float) -> np.ndarray:
    """Three rooms at a corridor, in the unknown; of the walls a share is unknown, too."""
    cells = np.full((110, 140), -1)
    walls = cells[25:85, 20:120]
    walls[:] = 100
    walls[2:24, 2:32] = walls[2:24, 34:65] = walls[2:24, 67:98] = walls[26:58, 2:98] = 0
    for col in (14, 46, 80):
        walls[24:26, col : col + 9] = 0
    is_hole = np.random.default_rng(1).random(walls.shape) < share
    walls[is_hole & (walls == 100)] = -1
    return cells


@pytest.mark.parametrize('share', [0.5, 0.7, 0.8])
def test_a_graph_between_walls_with_holes_is_that_between_whole_walls(share: float) -> None:
    _, right = graphs_of(rooms_of(0.0))
    _, reduced = graphs_of(rooms_of(share))
    ends, expected = ({n.position.tobytes() for n in g.nodes.values()} for g in (reduced, right))
    assert ends == expected
    assert len(reduced.edges) == len(right.edges)


@pytest.mark.parametrize('depth', [1, 2])
def test_specks_and_fringes_of_unknown_cells_end_no_branch(depth: int) -> None:
    cells = room(60, 100)
    cells[1 : 1 + depth] = cells[-1 - depth : -1] = -1
    cells[:, 1 : 1 + depth] = cells[:, -1 - depth : -1] = -1
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    whole, _ = graphs_of(cells)
    kept = whole.copy()
    routes.drop_rays(kept, patch_of(cells))
    assert kept.nodes.keys() == whole.nodes.keys()


def coverage_of(cells: np.ndarray) -> routes.Coverage:
    patch = patch_of(cells)
    standing = select_free_space(patch, None, CONFIG)
    return routes.coverage(build_along(patch, standing, None, CONFIG), patch, standing, CONFIG)


def test_a_graph_between_walls_covers_all() -> None:
    found = coverage_of(rooms_of(0.0))
    assert (found.unknown, found.rays) == (0.0, 0.0)


def test_a_corridor_that_is_narrower_than_a_step_of_places_is_covered() -> None:
    assert coverage_of(room(7, 300)).covered == 1.0


def test_floor_without_walls_is_not_covered() -> None:
    found = coverage_of(rooms_of(1.0))
    assert found.rays > 0.8
    assert found.unknown < 0.2
    assert found.covered == pytest.approx(1.0 - found.rays - found.unknown)


def test_floor_between_unknown_specks_is_not_covered() -> None:
    cells = rooms_of(0.0)
    is_speck = np.random.default_rng(2).random(cells.shape) < 0.15
    cells[27:49, 22:52][is_speck[27:49, 22:52]] = -1  # one of three rooms
    found = coverage_of(cells)
    assert 0.05 < found.unknown < 0.2
    assert found.rays == 0.0


def test_a_floor_with_glass_keeps_its_pruning(shared_data: Path) -> None:
    """Branches into fans of rays are dropped, and little else."""
    patch = read_map(shared_data / 'maps' / 'carmines_floor.yaml', keeps_unknown=True)
    standing = select_free_space(patch, None, CONFIG)
    whole = build_along(patch, standing, None, CONFIG)
    assert 0.005 < routes.coverage(whole, patch, standing, CONFIG).rays < 0.02


def test_places_see_the_node_that_is_nearest() -> None:
    cells = np.full((80, 200), 100)
    cells[5:35, 5:195] = 0
    cells[37:75, 90:110] = 0  # a niche behind a wall of 0.2 m, with its door at the left
    cells[35:37, 90:98] = 0
    whole, reduced = graphs_of(cells)
    patch = patch_of(cells)
    standing = select_free_space(patch, None, CONFIG)
    places = np.argwhere(standing)[::7]
    seen = 0
    for row, col in places:
        x, y = patch.frame.centres_of(np.array([[row, col]]))[0]
        node = reduced.nearest_node(x, y)
        assert node is not None
        to = patch.frame.cells_of(node.position)[0]
        seen += is_drivable(patch.free, row, col, to[0], to[1])
    assert len(reduced.nodes) <= len(whole.nodes) + 2
    assert seen / len(places) > 0.97


def test_one_room_has_an_edge() -> None:
    whole, reduced = graphs_of(room(50, 50))
    assert (len(whole.nodes), len(whole.edges)) == (1, 0)
    assert (len(reduced.nodes), len(reduced.edges)) == (2, 1)
    (edge,) = reduced.edges.values()
    assert edge.length_m > 1.0


def test_the_longer_of_two_parallel_edges_has_a_corner() -> None:
    """Two paths between the same nodes, one bent round a pillar."""
    cells = room(60, 100)
    patch = patch_of(cells)
    standing = select_free_space(patch, None, CONFIG)
    nodes = [Node(i, NodeKind.CORNER, x, 3.05, 1.0) for i, x in ((1, 2.05), (2, 8.05))]
    straight = np.column_stack([np.linspace(2.05, 8.05, 61), np.full(61, 3.05)])
    bent = straight + np.column_stack([np.zeros(61), 2 * np.sin(np.linspace(0, math.pi, 61))])
    edges = [Edge(3, 1, 2, straight, 6.0, 1.0), Edge(4, 1, 2, bent, 7.5, 0.9)]
    graph = EditedGraph(TopologicalMap(nodes, edges), patch.frame, standing, patch.free)
    routes.split_parallels(graph)
    ends = {frozenset((edge.a, edge.b)) for edge in graph.map.edges.values()}
    assert len(ends) == len(graph.map.edges) == 3
    (corner,) = (node for node in graph.map.nodes.values() if node.id not in (1, 2))
    assert corner.y == pytest.approx(5.05, abs=0.1)


def test_a_straight_line_may_pass_a_corner_of_cells() -> None:
    standing = np.eye(5, dtype=np.bool_)
    assert is_drivable(standing, 0, 0, 4, 4)
    assert not is_drivable(standing, 0, 0, 4, 3)
    standing[2, 2] = False
    assert not is_drivable(standing, 0, 0, 4, 4)


def seen_from(patch: GridPatch, standing: np.ndarray, graph: TopologicalMap) -> np.ndarray:
    """Distance of each traversable cell to the nearest node, m."""
    nodes = np.array([node.position for node in graph.nodes.values()])
    places = patch.frame.centres_of(np.argwhere(standing))
    return np.asarray(np.hypot(*np.moveaxis(places[:, None] - nodes, 2, 0)).min(axis=1))


def pillars() -> np.ndarray:
    """A hall of 20 m x 15 m with pillars of 0.5 m, and a wall in it."""
    cells = room(150, 200)
    for row in (30, 75, 120):
        for col in range(30, 200, 45):
            cells[row : row + 5, col : col + 5] = 100
    cells[50:54, 60:110] = 100
    return cells


def test_length_and_clearance_of_an_edge_are_those_of_its_line() -> None:
    for cells in (rough_corridor(), chairs(), pillars()):
        _, reduced = graphs_of(cells)
        obstacles = patch_of(cells).frame.centres_of(np.argwhere(cells != 0))
        for edge in reduced.edges.values():
            a, b = (reduced.nodes[i].position for i in (edge.a, edge.b))
            line = np.linspace(a, b, 200)
            away = np.hypot(*np.moveaxis(line[:, None] - obstacles, 2, 0)).min()
            assert edge.length_m == pytest.approx(math.dist(a, b))
            assert edge.clearance_m == pytest.approx(away, abs=0.1)


@pytest.mark.parametrize(('bend', 'edges'), [(2.0, 2), (0.8, 0)])
def test_an_edge_whose_line_is_blocked_leads_over_its_bend_or_goes(bend: float, edges: int) -> None:
    cells = room(60, 100)
    cells[25:37, 48:54] = 100
    patch = patch_of(cells)
    standing = select_free_space(patch, None, CONFIG)
    nodes = [Node(i, NodeKind.END, x, 3.05, 1.0) for i, x in ((1, 2.05), (2, 8.05))]
    height = 3.05 + bend * np.sin(np.linspace(0, math.pi, 61))
    path = np.column_stack([np.linspace(2.05, 8.05, 61), height])
    graph = EditedGraph(
        TopologicalMap(nodes, [Edge(3, 1, 2, path, 7.5, 0.9)]), patch.frame, standing, patch.free
    )
    routes.split_parallels(graph)
    assert len(graph.map.edges) == edges
    assert drivable_share(patch, graph.map, CONFIG.robot_radius_m) == float(edges > 0)


def test_places_are_near_a_node_and_routes_are_short() -> None:
    cells = pillars()
    patch = patch_of(cells)
    standing = select_free_space(patch, None, CONFIG)
    _, reduced = graphs_of(cells)
    assert (
        seen_from(patch, standing, reduced).max() < 3.0 * 1.2 + 0.4
    )  # half of a lattice of places
    assert len(reduced.nodes) < 0.12 * 300.0
    joined, longer = completeness(patch, reduced, CONFIG.robot_radius_m, 30, 0)
    assert (joined, len(reduced.components())) == (1.0, 1)
    assert longer < 1.1
    between = dict(networkx.all_pairs_dijkstra_path_length(as_networkx(reduced), weight='length'))
    for a, b in itertools.combinations(reduced.nodes.values(), 2):
        away_m = math.dist(a.position, b.position)
        ends = patch.frame.cells_of(np.array([a.position, b.position]))
        if away_m <= 7.2 and is_drivable(standing, *ends.ravel()):
            assert between[a.id][b.id] <= 1.2 * away_m + 1e-9


def as_networkx(graph: TopologicalMap) -> networkx.Graph:
    edges = [(edge.a, edge.b, edge.length_m) for edge in graph.edges.values()]
    made = networkx.Graph()
    made.add_weighted_edges_from(edges, weight='length')
    return made


def test_a_corridor_has_nodes_within_three_spacings() -> None:
    cells = np.full((30, 300), 100)
    cells[5:25, 5:295] = 0
    patch = patch_of(cells)
    standing = select_free_space(patch, None, CONFIG)
    for spacing_m, most in ((1.2, 6), (3.0, 3)):
        _, reduced = graphs_of(cells, spacing_m)
        assert seen_from(patch, standing, reduced).max() < 3.0 * spacing_m + 0.4
        assert len(reduced.nodes) <= most


def test_places_of_a_hall_are_near_a_node_whatever_the_spacing() -> None:
    cells = room(260, 400)
    standing = select_free_space(patch_of(cells), None, CONFIG)
    for spacing_m in (3.5, 7.0):
        _, reduced = graphs_of(cells, spacing_m)
        assert seen_from(patch_of(cells), standing, reduced).max() <= 3.0 * spacing_m + 0.5
