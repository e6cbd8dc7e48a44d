"""The map of a grid that changes: equal to the map of the whole grid, with stable ids."""

import math
import time
from itertools import pairwise

import numpy as np
import pytest
from drawings import patch_of, world

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.planning.wavefront import WavefrontConfig, plan
from thinmap_ros.core.topology.graph import NodeKind, TopologyConfig
from thinmap_ros.core.topology.topology import TopologyBuilder, build

PAD = 200


def windows(patch, way, size=100):
    """Windows of a finished map at points (N, 2) along a path, and the poses there."""
    cells = np.pad(patch.cells, PAD, constant_values=UNKNOWN)
    frame = patch.frame.with_origin_at(-PAD, -PAD)
    for x, y in way:
        row, col = (frame.cells_of(np.array([[x, y]]))[0] - size // 2).tolist()
        yield (
            GridPatch(
                frame.with_origin_at(row, col), cells[row : row + size, col : col + size].copy()
            ),
            np.array([x, y, 0]),
        )


def legs(*corners, step=0.3):
    points = []
    for a, b in pairwise(np.array(corners, dtype=float)):
        count = max(int(np.hypot(*(b - a)) / step), 1)
        points += [a + k / count * (b - a) for k in range(count)]
    return [*points, corners[-1]]


def building():
    """Two rings of corridors, 30 x 20 m, and rooms along the outer walls."""
    cells = np.full((220, 320), 100)
    cells[40:180, 40:280] = 0
    cells[60:160, 60:150] = cells[60:160, 170:260] = 100
    for col in (60, 120, 200):
        cells[184:210, col : col + 40] = 0
        cells[178:186, col + 15 : col + 25] = 0
    cells[8:36, 100:180] = 0
    cells[34:42, 130:142] = 0
    return patch_of(cells)


def contents(graph):
    """Nodes and edges without their ids."""
    nodes = {
        number: (round(n.x, 6), round(n.y, 6), int(n.kind), round(n.clearance_m, 6))
        for number, n in graph.nodes.items()
    }
    edges = [
        (*sorted((nodes[e.a], nodes[e.b])), round(e.length_m, 6), round(e.clearance_m, 6))
        for e in graph.edges.values()
    ]
    return sorted(nodes.values()), sorted(edges)


def ids(graph):
    nodes = {n.id: (round(n.x, 6), round(n.y, 6)) for n in graph.nodes.values()}
    return nodes, {e.id: (e.a, e.b) for e in graph.edges.values()}


def whole(builder):
    """The map of the whole grid that the builder has seen, from the same places."""
    return TopologyBuilder.from_state(builder.state(), builder.config).map


def loops(graph):
    return len(graph.edges) - len(graph.nodes) + len(graph.components())


def random_cells(rng, shape):
    """Rectangles of free cells, with small ones of any state in them."""
    cells = np.full(shape, UNKNOWN, dtype=np.int8)
    for _ in range(int(rng.integers(2, 9))):
        row, col = rng.integers(shape)
        height, width = rng.integers(5, 60, 2)
        cells[row : row + height, col : col + width] = 0
    for _ in range(int(rng.integers(0, 12))):
        row, col = rng.integers(shape)
        height, width = rng.integers(1, 12, 2)
        cells[row : row + height, col : col + width] = rng.choice([100, 100, UNKNOWN, 0])
    return cells


@pytest.mark.parametrize('seed', range(8))
def test_the_map_is_that_of_the_whole_grid_after_every_update(seed):
    check_updates(seed, TopologyConfig())


@pytest.mark.parametrize('radius_m', [0.0, 0.05])
def test_so_it_is_for_a_robot_that_is_a_point(radius_m):
    check_updates(3, TopologyConfig(robot_radius_m=radius_m))


def check_updates(seed, config):
    """Update a map by random windows, and compare it with that of the whole grid each time."""
    rng = np.random.default_rng(seed)
    shape = (120, 150)
    cells = np.full(shape, UNKNOWN, dtype=np.int8)
    builder = TopologyBuilder(config)
    for _ in range(20):
        low = rng.integers(0, (80, 110))
        size = rng.integers(10, 80, 2)
        part = tuple(slice(a, a + b) for a, b in zip(low, size, strict=True))
        kind = rng.integers(3)
        if kind == 0:
            cells[part] = random_cells(rng, shape)[part]
        else:
            part = (slice(0, shape[0]), slice(0, shape[1]))
            spots = rng.integers(shape, size=(20, 2))
            cells[spots[:, 0], spots[:, 1]] = rng.choice([UNKNOWN, 0, 100], 20)
        if kind == 2:
            cells = random_cells(rng, shape)
        frame = GridFrame(0.0, 0.0, 0.1).with_origin_at(part[0].start, part[1].start)
        T_map_base = np.array([rng.uniform(0.0, 15.0), rng.uniform(0.0, 12.0), 0.0])
        builder.update(GridPatch(frame, cells[part].copy()), T_map_base)
        again = whole(builder)
        assert contents(builder.map) == contents(again)
        assert ids(builder.map) == ids(again)


def test_a_drive_leads_to_the_map_of_the_whole():
    patch = building()
    builder = TopologyBuilder()
    round_trip = legs(
        (5, 5), (5, 17), (16, 17), (27, 17), (27, 5), (16, 5), (16, 17), (27, 17), (27, 5), (5, 5)
    )
    for window, T in windows(patch, round_trip):
        builder.update(window, T)
    assert contents(builder.map) == contents(build(patch, (5.0, 5.0), TopologyConfig()))
    assert contents(whole(builder)) == contents(builder.map)


def test_the_local_map_is_the_part_within_the_window():
    patch = building()
    builder = TopologyBuilder()
    for window, T in windows(patch, legs((5, 5), (5, 17), (16, 17))):
        builder.update(window, T)
    local = builder.local_map()
    assert 0 < len(local.nodes) < len(builder.map.nodes)
    for node in local.nodes.values():
        assert abs(node.x - 16.0) <= 5.1 and abs(node.y - 17.0) <= 5.1
        assert builder.map.nodes[node.id] == node
    assert local.edges.keys() <= builder.map.edges.keys()


def test_ids_stay_while_nothing_changes():
    patch = building()
    builder = TopologyBuilder()
    way = legs((5, 5), (5, 17), (16, 17), (16, 5), (5, 5))
    for window, T in windows(patch, way):
        builder.update(window, T)
    kept = asked = 0
    for window, T in windows(patch, way):
        before = dict(builder.map.nodes)
        builder.update(window, T)
        places = np.array([node.position for node in builder.map.nodes.values()])
        for number, node in before.items():
            in_view = max(abs(node.x - T[0]), abs(node.y - T[1])) < 3.0
            if in_view and (np.hypot(*(places - node.position).T) < 0.5).any():
                asked = asked + 1
                kept = kept + (number in builder.map.nodes)
    assert asked > 100 and kept >= 0.99 * asked


@pytest.mark.parametrize('shorter', [30, 60, 90])
def test_corners_of_a_path_whose_end_moved_keep_their_ids(shorter):
    cells = np.full((80, 420), 100)
    for col in range(10, 400):  # the width grows: no corridor
        cells[40 - 6 - col // 20 : 40 + 6 + col // 20, col] = 0
    patch = patch_of(cells)
    builder = TopologyBuilder()
    robot = np.array([5.0, 4.0, 0.0])
    builder.update(patch, robot)
    before = corners(builder.map)
    patch.cells[:, 400 - shorter :] = 100
    builder.update(patch, robot)
    after = corners(builder.map)
    kept = before.keys() & after.keys()
    assert len(before) >= 3
    assert len(kept) == min(len(before), len(after))
    assert max(math.dist(before[number], after[number]) for number in kept) > 0.5


def corners(graph):
    """Places of the nodes along paths, by id."""
    return {n.id: (n.x, n.y) for n in graph.nodes.values() if n.kind == NodeKind.CORNER}


def test_a_step_that_shows_a_hall_costs_little_more_than_thinning_it_at_once():
    cells = np.full((400, 1200), UNKNOWN, dtype=np.int8)
    builder = TopologyBuilder()
    ratios = []
    for first in range(0, 1200, 200):
        cells[40:360, first : first + 200] = 0
        cells[80:340:60, first + 20 : first + 200 : 60] = 100
        window = GridPatch(GridFrame(0.0, 0.0, 0.05), cells[:, max(first - 100, 0) :].copy())
        window = GridPatch(window.frame.with_origin_at(0, max(first - 100, 0)), window.cells)
        robot = np.array([(first + 10) * 0.05, 10.0, 0.0])
        began = time.process_time()
        builder.update(window, robot)
        updated = time.process_time()
        build(window, (robot[0], robot[1]), TopologyConfig())
        ratios.append((updated - began) / (time.process_time() - updated))
    # 2 where many cells are thinned at once, 30 where each is a change of its own.
    assert np.median(ratios[1:]) < 8.0


def test_ids_given_after_a_state_was_kept_are_not_given_again_to_other_places():
    patch = building()
    builder = TopologyBuilder()
    seen = list(windows(patch, legs((5, 5), (5, 17), (16, 17), (16, 5), (5, 5))))
    for window, T in seen[:20]:
        builder.update(window, T)
    state = builder.state()
    told = {*builder.map.nodes, *builder.map.edges}
    for window, T in seen[20:60]:
        builder.update(window, T)
        told |= {*builder.map.nodes, *builder.map.edges}
    successor = TopologyBuilder.from_state(state)
    known = {*successor.map.nodes, *successor.map.edges}
    successor.skip_ids(1000)
    for window, T in seen[60:]:
        successor.update(window, T)
    after = {*successor.map.nodes, *successor.map.edges}
    assert told - known and after - known
    assert not (after - known) & told


def test_a_place_that_changed_is_replaced():
    patch = building()
    builder = TopologyBuilder()
    way = legs((5, 5), (16, 5), (16, 17), (5, 17), (5, 5))
    for window, T in windows(patch, way):
        builder.update(window, T)
    rings = loops(builder.map)
    closed = GridPatch(patch.frame, patch.cells.copy())
    closed.cells[110:114, 150:170] = 100  # the passage at the centre
    for window, T in windows(closed, legs((5, 5), (16, 5), (16, 9), (16, 5))):
        builder.update(window, T)
    assert loops(builder.map) == rings - 1


def test_windows_of_any_place_and_size():
    patch = building()
    builder = TopologyBuilder()
    rng = np.random.default_rng(0)
    free = patch.frame.centres_of(np.argwhere(patch.free))
    for window, T in windows(patch, free[rng.integers(0, len(free), 60)]):
        builder.update(window, T)
    far = GridPatch(
        patch.frame.with_origin_at(100_000, -50_000), np.full((100, 100), UNKNOWN, dtype=np.int8)
    )
    before = contents(builder.map)
    assert not builder.update(far, np.array([0.0, 0.0, 0.0]))
    assert contents(builder.map) == before == contents(whole(builder))
    builder.update(patch, np.array([5.0, 5.0, 0.0]))
    assert contents(builder.map) == contents(build(patch, (5.0, 5.0), TopologyConfig()))


def test_a_loop_moves_the_map_and_ids_stay():
    patch = building()
    builder = TopologyBuilder()
    way = legs((5, 5), (5, 17), (16, 17), (16, 5), (5, 5))
    for window, T in windows(patch, way):
        builder.update(window, T)
    before = np.array([[x, y, 0.0] for x, y in way])
    moved = GridPatch(patch.frame.with_origin_at(0, 7), patch.cells)
    rebuilt = builder.rebuilt(moved, before, before + [0.7, 0.0, 0.0])
    assert contents(whole(builder)) == contents(builder.map), 'the old one is unchanged'
    assert contents(rebuilt.map) == contents(build(moved, (5.7, 5.0), TopologyConfig()))
    kept = 0
    for number, node in builder.map.nodes.items():
        known = rebuilt.map.nodes.get(number)
        kept += known is not None and math.dist((node.x + 0.7, node.y), (known.x, known.y)) < 0.5
    assert kept >= 0.8 * len(builder.map.nodes), 'where the drive has seen the same as the whole'
    fresh = {*rebuilt.map.nodes, *rebuilt.map.edges} - {*builder.map.nodes, *builder.map.edges}
    assert not fresh or min(fresh) >= builder._registry.next_id


def test_windows_off_the_lattice_are_refused():
    patch = building()
    builder = TopologyBuilder()
    ((window, T),) = windows(patch, [(5.0, 5.0)])
    builder.update(window, T)
    shifted = GridFrame(window.frame.origin_x + 0.04, window.frame.origin_y, 0.1)
    with pytest.raises(InputError, match='whole cells'):
        builder.update(GridPatch(shifted, window.cells), T)
    with pytest.raises(InputError, match=r'0\.05'):
        builder.update(GridPatch(GridFrame(0.0, 0.0, 0.05), window.cells), T)
    with pytest.raises(InputError, match='finite'):
        builder.update(window, np.array([math.nan, 0.0, 0.0]))


@pytest.mark.parametrize('name', ['dungeon/d1115', 'kth/50052751'])
def test_drives_through_floors_lead_to_the_map_of_the_whole(shared_data, name):
    patch, start = world(shared_data, name)
    config = TopologyConfig()
    way = [start]
    goals = [(node.x, node.y) for node in build(patch, start, config).nodes.values()][:40]
    while goals:
        goal = min(goals, key=lambda at: math.dist(at, way[-1]))
        goals.remove(goal)
        leg = plan(patch, way[-1], goal, WavefrontConfig())
        way += [] if leg is None else [tuple(at) for at in leg[::6].tolist()] + [goal]
    builder = TopologyBuilder(config)
    for count, (window, T) in enumerate(windows(patch, way)):
        builder.update(window, T)
        if count % 250 == 0:
            assert contents(builder.map) == contents(whole(builder))
    assert ids(builder.map) == ids(whole(builder))


def test_the_map_is_of_all_places_where_robots_are():
    cells = np.full((100, 200), 100, dtype=np.int8)
    cells[20:80, 20:80] = 0
    cells[20:80, 120:180] = 0
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), cells)
    poses = np.array([[5.0, 5.0, 0.0], [15.0, 5.0, 0.0]])
    one = TopologyBuilder()
    both = TopologyBuilder()
    one.update(patch, poses[0])
    both.update(patch, poses)
    assert len(one.map.components()) == 1
    assert len(both.map.components()) == 2
    with pytest.raises(InputError, match='expected finite numbers'):
        both.update(patch, np.array([[5.0, 5.0, 0.0], [math.nan, 5.0, 0.0]]))


@pytest.mark.parametrize('place', [(2.05, 2.05), (-50.0, -50.0)])
def test_a_robot_in_no_free_space_starts_nothing(place):
    cells = np.full((100, 100), 100, dtype=np.int8)
    cells[60:90, 60:90] = 0
    builder = TopologyBuilder(TopologyConfig(seed_search_radius_m=0.3))
    assert not builder.update(GridPatch(GridFrame(0.0, 0.0, 0.1), cells), np.array([*place, 0.0]))
    assert not builder.map.nodes
    assert builder.update(GridPatch(GridFrame(0.0, 0.0, 0.1), cells), np.array([7.5, 7.5, 0.0]))
    assert builder.map.nodes
