"""Known results for simple shapes, and invariants on any map."""

import numpy as np
import pytest
from drawings import drawn, patch_of, place, world
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from thinmap_ros.core.grid.raytrace import line_is_clear
from thinmap_ros.core.topology.graph import NodeKind, TopologyConfig
from thinmap_ros.core.topology.thinning import select_free_space
from thinmap_ros.core.topology.topology import build

E = NodeKind.END
B = NodeKind.BRANCH
C = NodeKind.CORNER
CONFIG = TopologyConfig()


def loops(graph):
    return len(graph.edges) - len(graph.nodes) + len(graph.components())


def assert_sound(patch, graph, free):
    """Edges are on free cells from node to node, and so are straight lines between their nodes."""
    assert not set(graph.nodes) & set(graph.edges) and min([*graph.nodes, 1]) >= 1
    for node in graph.nodes.values():
        assert free[tuple(patch.frame.cells_of(node.position)[0])]
        assert not (node.kind == B and len(graph.edges_at(node.id)) < 1)
    for edge in graph.edges.values():
        cells = patch.frame.cells_of(edge.path)
        assert np.abs(np.diff(cells, axis=0)).max(initial=1) == 1
        assert free[cells[:, 0], cells[:, 1]].all()
        assert np.allclose(edge.path[0], graph.nodes[edge.a].position)
        assert np.allclose(edge.path[-1], graph.nodes[edge.b].position)
        assert edge.length_m >= np.linalg.norm(edge.path[-1] - edge.path[0]) - 1e-9
        assert edge.clearance_m >= CONFIG.robot_radius_m - 1e-9
        if len(cells) > 2:
            assert line_is_clear(free, *cells[0], *cells[-1])
            assert line_is_clear(free, *cells[-1], *cells[0])
        assert edge.a != edge.b, (
            'a loop is broken by corners, or its straight line would lead nowhere'
        )


def shape(*lines, scale=10, seed=None):
    patch = drawn(*lines, scale=scale)
    graph = build(patch, seed, CONFIG)
    assert_sound(patch, graph, select_free_space(patch, seed, CONFIG))
    return graph


KNOWN = {
    'I': (['##########', '#........#', '##########'], {E: [(1, 1), (8, 1)]}, 0),
    'L': (
        ['########', '#.######', '#.######', '#.######', '#......#', '########'],
        {E: [(1, 1), (6, 4)], C: [(1, 4)]},
        0,
    ),
    'T': (
        ['#########', '#.......#', '####.####', '####.####', '#########'],
        {E: [(1, 1), (7, 1), (4, 3)], B: [(4, 1)]},
        0,
    ),
    '+': (
        ['#########', '####.####', '####.####', '#.......#', '####.####', '####.####', '#########'],
        {E: [(4, 1), (1, 3), (7, 3), (4, 5)], B: [(4, 3)]},
        0,
    ),
    'ring': (
        ['########', '#......#', '#.####.#', '#.####.#', '#......#', '########'],
        {C: [(1, 1), (6, 1), (1, 4), (6, 4)]},
        1,
    ),
    'ring with spur': (
        [
            '###########',
            '#......####',
            '#.####.####',
            '#.####....#',
            '#.####.####',
            '#......####',
            '###########',
        ],
        {C: [(1, 1), (6, 1), (1, 5), (6, 5)], B: [(6, 3)], E: [(9, 3)]},
        1,
    ),
    'comb': (
        ['###########', '#.#.#.#.#.#', '#.#.#.#.#.#', '#.#.#.#.#.#', '#.........#', '###########'],
        {
            E: [(1, 1), (3, 1), (5, 1), (7, 1), (9, 1)],
            B: [(3, 4), (5, 4), (7, 4)],
            C: [(1, 4), (9, 4)],
        },
        0,
    ),
    'spiral': (
        [
            '#########',
            '#.......#',
            '#######.#',
            '#.....#.#',
            '#.###.#.#',
            '#.#...#.#',
            '#.#####.#',
            '#.......#',
            '#########',
        ],
        {E: [(1, 1), (3, 5)], C: [(7, 1), (7, 7), (1, 7), (1, 3), (5, 3), (5, 5)]},
        0,
    ),
}


@pytest.mark.parametrize('name', KNOWN)
def test_known_answers(name):
    lines, wanted, ring_count = KNOWN[name]
    graph = shape(*lines)
    kinds = sorted(k for k, at in wanted.items() for _ in at)
    assert sorted(node.kind for node in graph.nodes.values()) == kinds
    for kind, places in wanted.items():
        for col, row in places:
            x, y = place(col, row, len(lines))
            near = [
                n
                for n in graph.nodes.values()
                if n.kind == kind and np.hypot(n.x - x, n.y - y) <= 0.6
            ]
            assert len(near) == 1, f'{kind.name} at {(x, y)}'
    assert loops(graph) == ring_count and len(graph.components()) == 1


def test_open_hall_is_one_place():
    graph = shape(*['#' * 14, *['#............#'] * 12, '#' * 14])
    (node,) = graph.nodes.values()
    assert node.kind == E and not graph.edges
    assert np.hypot(node.x - 7.0, node.y - 7.0) <= 0.6
    assert node.clearance_m == pytest.approx(6.0, abs=0.3)


def test_two_rooms_and_a_door():
    lines = [
        '#' * 17,
        *['#.......#.......#'] * 3,
        '#...............#',
        *['#.......#.......#'] * 3,
        '#' * 17,
    ]
    graph = shape(*lines)
    # From corners of the rooms, only a node between the two is seen.
    assert sorted(node.kind for node in graph.nodes.values()) == [E, E, C]
    xs = sorted(node.x for node in graph.nodes.values())
    assert xs[0] < 8.0 < 9.0 < xs[2]
    for edge in graph.edges.values():
        assert edge.clearance_m == pytest.approx(0.5, abs=0.11)


def test_pillar_hall_has_a_loop_for_each_pillar():
    cells = np.full((160, 160), 100)
    cells[5:-5, 5:-5] = 0
    for row in (40, 80, 120):
        for col in (40, 80, 120):
            cells[row - 4 : row + 4, col - 4 : col + 4] = 100
    patch = patch_of(cells)
    graph = build(patch, None, CONFIG)
    assert_sound(patch, graph, select_free_space(patch, None, CONFIG))
    assert loops(graph) == 9 and len(graph.components()) == 1
    assert all(node.clearance_m > 1.0 for node in graph.nodes.values() if node.kind == B)


def test_nothing_free_nothing_found():
    for value in (100, -1):
        graph = build(patch_of(np.full((30, 40), value)), None, CONFIG)
        assert not graph.nodes and not graph.edges
    assert not build(patch_of(np.zeros((2, 2))), None, CONFIG).nodes, 'smaller than the robot'


@pytest.mark.parametrize('size', [9, 10, 11, 12, 13])
def test_square_that_thinning_erases_keeps_a_node(size):
    cells = np.full((30, 30), 100)
    cells[8 : 8 + size, 8 : 8 + size] = 0
    graph = build(patch_of(cells), None, CONFIG)
    (node,) = graph.nodes.values()
    assert abs(node.x - (8 + size / 2) * 0.1) <= 0.15 and abs(node.y - (8 + size / 2) * 0.1) <= 0.15


def test_bumps_of_noise_make_no_spurs():
    rng = np.random.default_rng(5)
    cells = np.full((40, 200), 100)
    cells[10:30, 10:190] = 0
    for col in rng.integers(10, 190, 60):
        cells[rng.choice([9, 10, 29, 30]), col] = rng.choice([0, 100])
    graph = build(patch_of(cells), None, CONFIG)
    assert sorted(node.kind for node in graph.nodes.values()) == [E, E]


def test_ends_stand_at_the_rim_of_the_known():
    cells = np.full((60, 160), -1)
    cells[20:22] = 100
    cells[40:42] = 100
    cells[22:40, 10:120] = 0
    cells[20:42, 8:10] = 100
    cells[22:40, 110:120] = np.where(np.random.default_rng(0).random((18, 10)) < 0.3, -1, 0)
    graph = build(patch_of(cells), (3.0, 3.0), CONFIG)
    assert sorted(node.kind for node in graph.nodes.values()) == [E, E]
    far = max(graph.nodes.values(), key=lambda node: node.x)
    assert 9.8 <= far.x <= 12.0


def random_building(seed):
    rng = np.random.default_rng(seed)
    cells = np.full((90, 120), 100)
    for _ in range(9):
        row = rng.integers(3, 70)
        col = rng.integers(3, 90)
        cells[row : row + rng.integers(8, 30), col : col + rng.integers(8, 40)] = 0
    for _ in range(rng.integers(0, 12)):
        row = rng.integers(0, 86)
        col = rng.integers(0, 116)
        value = rng.choice([100, -1])
        cells[row : row + rng.integers(1, 4), col : col + rng.integers(1, 4)] = value
    cells[:2] = 100
    cells[-2:] = 100
    cells[:, :2] = 100
    cells[:, -2:] = 100
    return patch_of(cells)


@given(st.integers(0, 100_000))
@settings(max_examples=60)
def test_any_building_is_drivable_and_complete(seed):
    patch = random_building(seed)
    free = select_free_space(patch, None, CONFIG)
    graph = build(patch, None, CONFIG)
    assert_sound(patch, graph, free)
    parts, count = ndimage.label(free, np.ones((3, 3)))
    assert len(graph.components()) == count
    for part in graph.components():
        cells = patch.frame.cells_of(np.array([graph.nodes[k].position for k in part]))
        assert len({int(parts[r, c]) for r, c in cells}) == 1


@given(st.integers(0, 100_000))
@settings(max_examples=40)
def test_as_many_loops_as_holes(seed):
    patch = random_building(seed)
    free = select_free_space(patch, None, CONFIG)
    holes = ndimage.label(np.pad(~free, 1, constant_values=True))[1] - 1
    assert loops(build(patch, None, CONFIG)) == holes


@pytest.mark.parametrize('name', ['kth/50052751', 'dungeon/d114', 'dungeon/d1573'])
def test_every_free_place_sees_the_graph(shared_data, name):
    """A straight line leads to one of the nearest nodes, along which route planners drive."""
    patch, start = world(shared_data, name)
    free = select_free_space(patch, start, CONFIG)
    graph = build(patch, start, CONFIG)
    nodes = patch.frame.cells_of(np.array([n.position for n in graph.nodes.values()]))
    rng = np.random.default_rng(0)
    places = np.argwhere(free)
    hidden = 0
    for at in places[rng.integers(0, len(places), 400)]:
        nearest = nodes[np.argsort(((nodes - at) ** 2).sum(axis=1))[:12]]
        hidden += not any(line_is_clear(free, *at, *node) for node in nearest)
    assert hidden <= 2


@pytest.mark.parametrize(
    'name', ['kth/50052751', 'kth/50052748', 'dungeon/d114', 'dungeon/d1848', 'dungeon/d3641']
)
def test_floors_are_drivable_and_complete(shared_data, name):
    patch, start = world(shared_data, name)
    free = select_free_space(patch, start, CONFIG)
    graph = build(patch, start, CONFIG)
    assert_sound(patch, graph, free)
    assert len(graph.components()) == 1
    holes = ndimage.label(np.pad(~free, 1, constant_values=True))[1] - 1
    assert loops(graph) == holes
    assert len(graph.nodes) <= 130, 'a floor is some hundred places'
