"""Merging of local maps into the global one: equal to the batch map, with stable ids."""

import math
from itertools import pairwise

import numpy as np
import pytest
from drawings import patch_of, world

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import UNKNOWN, GridPatch
from thinmap_ros.core.planning.wavefront import WavefrontConfig, plan
from thinmap_ros.core.topology.builder import TopologyBuilder, TopologyConfig, build

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


def agreement(one, other):
    a, b = (np.array([node.position for node in graph.nodes.values()]) for graph in (one, other))
    distance = np.hypot(*np.moveaxis(a[:, None] - b, 2, 0))
    return (distance.min(axis=1) <= 0.5).mean(), (distance.min(axis=0) <= 0.5).mean()


def loops(graph):
    return len(graph.edges) - len(graph.nodes) + len(graph.components())


def assert_like(graph, batch):
    assert min(agreement(graph, batch)) >= 0.95
    assert (loops(graph), len(graph.components())) == (loops(batch), len(batch.components()))


def test_a_drive_leads_to_the_map_of_the_whole():
    patch = building()
    builder = TopologyBuilder()
    round_trip = legs(
        (5, 5), (5, 17), (16, 17), (27, 17), (27, 5), (16, 5), (16, 17), (27, 17), (27, 5), (5, 5)
    )
    for window, T in windows(patch, round_trip):
        builder.update(window, T)
    assert_like(builder.map, build(patch, (5.0, 5.0), TopologyConfig()))
    # Every place has one chain: repeated cutting and merging makes no duplicates.
    chains = builder._atlas.chains.values()
    cells = np.concatenate([chain.cells for chain in chains])
    assert len(cells) <= 1.1 * len(np.unique(cells, axis=0)) + 20


def test_what_only_the_far_ends_of_beams_change_is_drawn_in_too():
    patch = building()
    here = [(5.0, 12.0)]
    builder = TopologyBuilder()
    ((open_window, T),) = windows(patch, here, size=160)
    builder.update(open_window, T)
    far = [node for node in builder.map.nodes.values() if abs(node.y - 12.0) > 6.0]
    assert far, 'the window beyond the near part is drawn'
    patch.cells[40:60, 40:90] = 100  # the corner of the corridors, 6 to 8 m away
    ((window, T),) = windows(patch, here, size=160)
    for _ in range(5):
        builder.update(window, T)
    assert not any(4.0 < node.x < 9.0 and 4.0 < node.y < 6.0 for node in builder.map.nodes.values())
    assert all(
        abs(node.x - 5.0) <= 5.0 and abs(node.y - 12.0) <= 5.0
        for node in builder.local_map().nodes.values()
    )


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


def test_jumps_and_far_away_windows_do_not_break_the_map():
    patch = building()
    builder = TopologyBuilder()
    rng = np.random.default_rng(0)
    free = patch.frame.centres_of(np.argwhere(patch.free))
    sizes = []
    for _ in range(8):
        for window, T in windows(patch, free[rng.integers(0, len(free), 12)]):
            builder.update(window, T)
        sizes.append(sum(len(chain.cells) for chain in builder._atlas.chains.values()))
    assert sizes[-1] <= 2 * sizes[1], 'the web does not grow where nothing is new'
    far = GridPatch(
        patch.frame.with_origin_at(100_000, -50_000), np.full((100, 100), UNKNOWN, dtype=np.int8)
    )
    builder.update(far, np.array([0.0, 0.0, 0.0]))


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


@pytest.mark.slow
@pytest.mark.parametrize('name', ['dungeon/d1115', 'dungeon/d2555', 'kth/50052751'])
def test_drives_through_floors_lead_to_the_map_of_the_whole(shared_data, name):
    patch, start = world(shared_data, name)
    config = TopologyConfig()
    batch = build(patch, start, config)
    way = [start]
    goals = [(node.x, node.y) for node in batch.nodes.values()]
    while goals:
        goal = min(goals, key=lambda at: math.dist(at, way[-1]))
        goals.remove(goal)
        leg = plan(patch, way[-1], goal, WavefrontConfig())
        way += [] if leg is None else [tuple(at) for at in leg[::6].tolist()] + [goal]
    builder = TopologyBuilder(config)
    shown = np.full_like(np.pad(patch.cells, PAD), UNKNOWN)
    for window, T in windows(patch, way):
        builder.update(window, T)
        row, col = (
            patch.frame.cells_of(np.array([[window.frame.origin_x, window.frame.origin_y]]) + 0.05)[
                0
            ]
            + PAD
        )
        shown[row : row + 100, col : col + 100] = window.cells
    # The batch map must not contain more than the windows.
    assert_like(
        builder.map, build(GridPatch(patch.frame.with_origin_at(-PAD, -PAD), shown), start, config)
    )


@pytest.mark.parametrize('place', [(2.05, 2.05), (-50.0, -50.0)])
def test_a_robot_in_no_free_space_starts_nothing(place):
    cells = np.full((100, 100), 100, dtype=np.int8)
    cells[60:90, 60:90] = 0
    builder = TopologyBuilder(TopologyConfig(seed_search_radius_m=0.3))
    assert not builder.update(GridPatch(GridFrame(0.0, 0.0, 0.1), cells), np.array([*place, 0.0]))
    assert builder._view.robot.shape == (0, 2)
    assert not builder._view.free.any()
    assert builder.update(GridPatch(GridFrame(0.0, 0.0, 0.1), cells), np.array([7.5, 7.5, 0.0]))
    assert builder._view.robot.shape == (1, 2)
