"""Regions of a known floor: kinds, areas, doors, outlines, nodes and edges; and of a noisy one."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from core.topology.floors import CELL_M, noisy, office, patch_of

from thinmap_ros.core.grid.patch import UNKNOWN
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.regions import RegionKind, RegionMap, membership_of
from thinmap_ros.core.topology.segmentation import RegionConfig, find_regions, outline_of
from thinmap_ros.core.topology.topology import build
from thinmap_ros.files.occupancy_maps import read_map

CORRIDOR = (7.0, 3.2)
LEFT = (3.0, 7.0)
RIGHT = (11.0, 7.0)


def at(found: RegionMap, *points: tuple[float, float]) -> list[int]:
    ids = found.ids_at(np.array(points)).tolist()
    assert all(ids)
    return ids


def area_of(polygon: np.ndarray) -> float:
    """Signed: positive counterclockwise."""
    x, y = polygon.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def test_two_rooms_on_a_corridor() -> None:
    found = find_regions(patch_of(office()))
    corridor, left, right = at(found, CORRIDOR, LEFT, RIGHT)
    assert found.regions.keys() == {corridor, left, right}
    kinds = {number: region.kind for number, region in found.regions.items()}
    room = RegionKind.ROOM
    assert kinds == {corridor: RegionKind.CORRIDOR, left: room, right: room}
    assert found.regions[left].area_m2 == pytest.approx(39.0, rel=0.05)
    assert found.regions[corridor].area_m2 == pytest.approx(32.0, rel=0.05)
    assert found.neighbours(corridor) == sorted([left, right])
    assert found.neighbours(left) == [corridor]
    assert sorted((round(door.x, 1), round(door.width_m, 1)) for door in found.doors) == [
        pytest.approx((2.5, 1.0), abs=0.2),
        pytest.approx((11.5, 1.0), abs=0.2),
    ]


def test_centre_and_outline_lie_in_the_region() -> None:
    found = find_regions(patch_of(office()))
    for region in found.regions.values():
        assert at(found, (region.x, region.y)) == [region.id]
        assert area_of(region.outline) == pytest.approx(region.area_m2, rel=0.05)


def test_a_wide_room_is_a_hall_and_a_wide_door_separates_only_up_to_a_width() -> None:
    cells = office()
    cells[22, 30:54] = 0
    narrow = find_regions(patch_of(cells), RegionConfig(max_door_width_m=1.5, min_hall_width_m=4.0))
    corridor, left, right = at(narrow, CORRIDOR, LEFT, RIGHT)
    assert corridor == left != right
    assert narrow.regions[right].kind == RegionKind.HALL


@pytest.mark.parametrize(('width_m', 'kind'), [(3.2, RegionKind.ROOM), (4.5, RegionKind.CORRIDOR)])
def test_how_wide_a_corridor_may_be_is_set(width_m: float, kind: RegionKind) -> None:
    cells = np.full((44, 304), 100, dtype=np.int8)
    cells[2:42, 2:302] = 0
    found = find_regions(patch_of(cells), RegionConfig(max_corridor_width_m=width_m))
    assert [region.kind for region in found.regions.values()] == [kind]


def test_noise_changes_no_region(rng: np.random.Generator) -> None:
    found = find_regions(patch_of(noisy(office(), rng)))
    assert len(set(at(found, CORRIDOR, LEFT, RIGHT))) == len(found.regions) == 3
    assert len(found.doors) == 2


def test_a_table_makes_no_door_and_a_thin_wall_does() -> None:
    cells = office()
    cells[43:53, 30:42] = 100
    assert len(find_regions(patch_of(cells)).regions) == 3
    cells[23:45, 38] = 100
    cells[54:73, 38] = 100
    assert len(find_regions(patch_of(cells)).regions) == 4


def test_a_cabin_of_five_square_metres_is_a_room() -> None:
    cells = office()
    cells[48, 82:162] = 100
    cells[48:73, 104] = 100
    cells[48, 89:99] = 0
    cabin, rest = at(find_regions(patch_of(cells)), (8.3, 8.2), (11.0, 5.0))
    assert cabin != rest


def test_a_niche_is_no_region_of_its_own() -> None:
    cells = office()
    cells[50:73, 2:70] = 100
    cells[52:69, 20:36] = 0
    cells[50:52, 25:31] = 0
    room, niche = at(find_regions(patch_of(cells)), (3.0, 5.0), (1.7, 8.0))
    assert room == niche


def test_an_open_leaf_does_not_divide_a_corridor() -> None:
    cells = office()
    cells[10:22, 40] = 100
    found = find_regions(patch_of(cells))
    before, behind = at(found, CORRIDOR, (1.0, 3.2))
    assert before == behind
    assert len(found.doors) == 2


def test_cupboards_along_the_walls_make_no_corridor_of_a_room() -> None:
    cells = np.full((55, 110), 100, dtype=np.int8)
    cells[2:53, 2:108] = 0
    cells[2:8, 8:100:20] = 100
    cells[2:6, 12:100:10] = 100
    cells[45:53, 10:100:12] = 100
    cells[49:53, 14:100:12] = 100
    found = find_regions(patch_of(cells))
    assert [region.kind for region in found.regions.values()] == [RegionKind.ROOM]


def test_corridors_that_meet_are_one_region() -> None:
    cells = np.full((160, 200), 100, dtype=np.int8)
    cells[2:27, 2:198] = 0
    cells[27:158, 90:106] = 0
    cells[140:158, 2:198] = 0
    found = find_regions(patch_of(cells))
    assert [region.kind for region in found.regions.values()] == [RegionKind.CORRIDOR]
    assert not found.doors


def test_a_map_without_free_space_has_no_regions() -> None:
    found = find_regions(patch_of(np.full((30, 40), 100, dtype=np.int8)))
    assert not found.regions
    assert not found.doors
    assert not found.labels.any()
    assert membership_of(TopologicalMap(), found).of_node == {}


def test_nodes_and_edges_know_their_region() -> None:
    patch = patch_of(office())
    found = find_regions(patch)
    topology = build(patch, None, TopologyConfig())
    member = membership_of(topology, found)
    assert member.of_node.keys() == topology.nodes.keys()
    assert member.of_edge.keys() == topology.edges.keys()
    for number, node in topology.nodes.items():
        assert at(found, (node.x, node.y)) == [member.of_node[number]]
    through = {number for door in found.doors for number in member.edges_through(door)}
    assert through == member.door_of.keys() and len(through) == 2
    assert all(member.edges_through(door) for door in found.doors)


def test_doors_of_edges_are_those_of_a_search_among_all() -> None:
    patch = patch_of(np.tile(office(), (2, 2)))
    found = find_regions(patch)
    topology = build(patch, None, TopologyConfig())
    member = membership_of(topology, found)
    for number, edge in topology.edges.items():
        steps = [np.linspace(a, b, 50) for a, b in itertools.pairwise(edge.path)]
        path = np.concatenate(steps)
        inside = {*found.ids_at(path).tolist(), member.of_node[edge.a], member.of_node[edge.b]}
        widths = [
            door.width_m
            for door in found.doors
            if {door.a, door.b} <= inside
            and np.hypot(*(path - (door.x, door.y)).T).min() <= 0.5 * door.width_m
        ]
        narrowest = member.door_of.get(number)
        assert (min(widths) if widths else None) == (narrowest and narrowest.width_m)
    assert len(member.door_of) >= 8


def test_outline_of_a_ring_is_its_outer_border() -> None:
    frame = patch_of(office()).frame
    cells = np.ones((4, 5), dtype=np.bool_)
    cells[1:3, 1:4] = False
    corners = np.round((outline_of(cells, frame) - (-1.0, 2.0)) / CELL_M)
    assert corners.tolist() == [[0, 0], [5, 0], [5, 4], [0, 4]]
    assert outline_of(np.zeros((2, 2), dtype=np.bool_), frame).shape == (0, 2)


def test_outline_stays_with_the_largest_part_where_cells_meet_at_a_corner() -> None:
    frame = patch_of(office()).frame
    cells = np.array([[1, 1, 0], [0, 1, 0], [0, 0, 1]], dtype=np.bool_)
    corners = np.round((outline_of(cells, frame) - (-1.0, 2.0)) / CELL_M)
    assert corners.tolist() == [[0, 0], [2, 0], [2, 2], [1, 2], [1, 1], [0, 1]]


def l_shaped() -> np.ndarray:
    """A room with two legs of 9 x 4 m, and a block of 1.6 x 1.6 m in the bend."""
    cells = np.full((114, 114), UNKNOWN, dtype=np.int8)
    cells[10:104, 10:104] = 100
    cells[12:102, 12:102] = 0
    cells[52:102, 52:102] = 100
    cells[24:40, 24:40] = 100
    return cells


def test_a_block_at_its_bend_does_not_divide_an_l_shaped_room() -> None:
    found = find_regions(patch_of(l_shaped()))
    assert [region.kind for region in found.regions.values()] == [RegionKind.ROOM]
    assert not found.doors


def test_the_rim_of_a_table_is_furniture_as_the_whole_table() -> None:
    cells = l_shaped()
    cells[25:39, 25:39] = 0
    found = find_regions(patch_of(cells))
    assert [region.kind for region in found.regions.values()] == [RegionKind.ROOM]


@pytest.mark.parametrize('inside', [UNKNOWN, 0])
def test_a_small_room_with_niches_is_no_corridor(inside: int) -> None:
    """A room of 6 x 2.4 m with niches: a laser may have seen its rim only."""
    cells = np.full((60, 90), UNKNOWN, dtype=np.int8)
    cells[8:52, 8:82] = 100
    cells[18:42, 14:74] = 0
    for col in range(18, 74, 14):
        cells[12:18, col : col + 8] = 0
        cells[42:48, col : col + 8] = 0
    cells[26:34, 22:66] = inside
    found = find_regions(patch_of(cells))
    assert [region.kind for region in found.regions.values()] == [RegionKind.ROOM]


def test_rays_behind_glass_are_in_no_region() -> None:
    """A gap of 1 m in the wall of the left room, and a fan of rays of 6 m behind it."""
    cells = np.pad(office(), ((0, 0), (70, 0)), constant_values=UNKNOWN)
    cells[45:55, 71] = 0
    rows, cols = np.mgrid[0:75, 0:71]
    away = 76 - cols
    cells[:, :71][(np.abs(rows - 50) <= 0.35 * away) & (away < 60)] = 0
    found = find_regions(patch_of(cells, (-8.0, 2.0)))
    assert len(found.regions) == 3
    assert not found.ids_at(np.array([(x, 7.0) for x in np.arange(-7.0, -2.5, 0.5)])).any()
    assert len(set(at(found, CORRIDOR, (-0.5, 7.0), LEFT, RIGHT))) == 3


def test_a_free_map_that_was_cut_out_of_a_larger_one_is_a_region() -> None:
    found = find_regions(patch_of(np.zeros((50, 50), dtype=np.int8)))
    assert len(found.regions) == 1


ROOM = RegionKind.ROOM
# By eye: a point in each region, m, and its kind.
HOMES = {
    'elsabot_4wd/maps/office': {(-1.3, -0.5): ROOM},
    'elsabot_4wd/maps/upstairs': {(-1.7, 3.1): ROOM, (-7.2, 2.4): ROOM},
    'elsabot_4wd/maps/upstairs2': {(-0.1, -1.3): ROOM, (1.0, -7.1): ROOM},
    'ecn_house': {
        (9.2, -5.0): ROOM,
        (-3.4, -3.9): ROOM,
        (-3.4, 2.9): ROOM,
        (9.5, -0.2): ROOM,
        (4.1, 2.0): ROOM,
        (2.0, -0.2): ROOM,
    },
    'kobuki_lab': {(0.6, 6.4): ROOM, (-1.4, 0.1): ROOM, (-4.8, 4.5): ROOM},
    'kobuki_aws_warehouse': {(-0.8, -2.4): ROOM, (-4.5, 5.8): ROOM},
    'marrtino_r3d/maps/casa': {(3.5, -3.1): ROOM, (2.5, -5.3): ROOM, (1.2, -0.7): ROOM},
    'marrtino_r3d/maps/garage': {
        (8.0, 6.3): ROOM,
        (1.3, 0.0): RegionKind.CORRIDOR,
        (10.2, 3.9): ROOM,
    },
}


@pytest.mark.filterwarnings('ignore:.*grey 205')
@pytest.mark.parametrize('name', HOMES)
def test_kinds_of_homes_are_those_that_one_sees(name: str, shared_data: Path) -> None:
    path = shared_data / 'maps' / 'homes' / f'{name}.yaml'
    if not path.exists():
        pytest.skip(f'needs {path}')
    found = find_regions(read_map(path, keeps_unknown=True))
    numbers = at(found, *HOMES[name])
    assert [found.regions[number].kind for number in numbers] == list(HOMES[name].values())
    assert len(found.regions) == len(set(numbers))
