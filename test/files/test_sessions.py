"""Saved sessions: a restored state continues as if there had been no interruption."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.explorer import Explorer
from thinmap_ros.core.grid.edits import KeepOut, MapEdits
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array, pose
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.stage import LOCALIZATION
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import TopologyBuilder
from thinmap_ros.files.occupancy_maps import write_map
from thinmap_ros.files.sessions import (
    EXPLORATION,
    GRID,
    LOCALIZER,
    TOPOLOGY,
    load_edits,
    load_grid,
    load_localizer,
    load_tag,
    save_grid,
    save_localizer,
    stem_of,
)
from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig
from thinmap_ros.sim.world import World


def building() -> World:
    """Corridors round a block, with a room to the left."""
    occupied = np.ones((120, 300), dtype=np.uint8)
    occupied[10:110, 110:290] = occupied[50:70, 80:110] = occupied[30:90, 10:80] = 0
    occupied[35:85, 140:260] = 1
    return World('building', occupied, GridFrame(0.0, 0.0, 0.1), pose(12.5, 6.0, 0.0))


def way() -> list[Array]:
    corners = [
        (3.0, 6.0),
        (12.5, 6.0),
        (12.5, 10.0),
        (27.5, 10.0),
        (27.5, 2.0),
        (12.5, 2.0),
        (12.5, 6.0),
        (3.0, 6.0),
    ]
    poses = []
    for (x, y), (to_x, to_y) in pairwise(corners):
        heading = math.atan2(to_y - y, to_x - x)
        steps = int(math.hypot(to_x - x, to_y - y) / 0.25)
        poses += [
            pose(x + k / steps * (to_x - x), y + k / steps * (to_y - y), heading)
            for k in range(steps)
        ]
    return poses


def drive(grid: OccupancyGrid, builder: TopologyBuilder, poses: list[Array], seed: int) -> None:
    laser = LaserScanner(LaserScannerConfig(), seed)
    world = building()
    for k, T in enumerate(poses):
        grid.add_scan(laser.scan(world, T, k), T)
        builder.update(grid.window(T[0], T[1], 10.0), T)


def assert_same(one: TopologicalMap, other: TopologicalMap) -> None:
    assert one.nodes == other.nodes
    assert one.edges.keys() == other.edges.keys()
    for number, edge in one.edges.items():
        twin = other.edges[number]
        assert (edge.a, edge.b, edge.length_m, edge.clearance_m) == (
            twin.a,
            twin.b,
            twin.length_m,
            twin.clearance_m,
        )
        assert np.array_equal(edge.path, twin.path)


def test_work_continues_as_without_interruption(tmp_path: Path) -> None:
    grid = OccupancyGrid(PAPER_GRID)
    builder = TopologyBuilder()
    poses = way()
    drive(grid, builder, poses[:120], 0)
    GRID.write(tmp_path / 'a.grid.npz', grid)
    TOPOLOGY.write(tmp_path / 'a.topology.npz', builder)
    again = GRID.read(tmp_path / 'a.grid.npz')
    restored = TOPOLOGY.read(tmp_path / 'a.topology.npz')
    assert len(builder.map.nodes) > 2
    assert_same(builder.map, restored.map)
    drive(grid, builder, poses[120:], 1)
    drive(again, restored, poses[120:], 1)
    assert (
        np.array_equal(grid.known_area().cells, again.known_area().cells)
        and grid.known_area().frame == again.known_area().frame
    )
    assert_same(builder.map, restored.map)
    for key, array in grid.state().items():
        assert np.array_equal(array, again.state()[key]) or key in ('tiles', 'log_odds')
    assert len(list(tmp_path.iterdir())) == 2


def test_nothing_seen_yet(tmp_path: Path) -> None:
    GRID.write(tmp_path / 'a.npz', OccupancyGrid(PAPER_GRID))
    TOPOLOGY.write(tmp_path / 'b.npz', TopologyBuilder())
    assert GRID.read(tmp_path / 'a.npz').known_area().unknown.all()
    assert not TOPOLOGY.read(tmp_path / 'b.npz').map.nodes


def test_inconsistent_states_are_reported(tmp_path: Path) -> None:
    grid = OccupancyGrid(PAPER_GRID)
    builder = TopologyBuilder()
    drive(grid, builder, way()[:5], 0)
    GRID.write(tmp_path / 'a.npz', grid)
    TOPOLOGY.write(tmp_path / 'b.npz', builder)
    for path in (tmp_path / 'b.npz', tmp_path / 'no.npz'):
        with pytest.raises(InputError, match='npz'):
            GRID.read(path)
    with pytest.raises(InputError, match='expected a saved topology'):
        TOPOLOGY.read(tmp_path / 'a.npz')
    again = GRID.read(tmp_path / 'a.npz', OccupancyConfig(resolution_m=0.05))
    assert again.frame.resolution == grid.frame.resolution
    # Another robot fits elsewhere: the graph is that of the same cells.
    assert not TOPOLOGY.read(tmp_path / 'b.npz', TopologyConfig(robot_radius_m=3.0)).map.nodes


@pytest.mark.parametrize('end', ['', '.grid.npz', '.topology.npz', '.yaml', '.pgm'])
def test_a_session_is_named_by_its_stem_or_one_of_its_files(tmp_path: Path, end: str) -> None:
    grid = OccupancyGrid(PAPER_GRID)
    builder = TopologyBuilder()
    drive(grid, builder, way()[:5], 0)
    path = str(tmp_path / 'v1.2' / 'room.one') + end
    assert not TOPOLOGY.exists(path)
    save_grid(path, grid)
    TOPOLOGY.save(path, builder)
    assert {file.name for file in (tmp_path / 'v1.2').iterdir()} == {
        f'room.one{each}' for each in ('.grid.npz', '.topology.npz', '.yaml', '.pgm')
    }
    assert TOPOLOGY.exists(path)
    assert np.array_equal(load_grid(path).state()['log_odds'], grid.state()['log_odds'])
    assert_same(TOPOLOGY.load(path).map, builder.map)


def test_edits_are_saved_beside_the_grid_and_archived_where_there_are_none(tmp_path: Path) -> None:
    grid = OccupancyGrid(PAPER_GRID)
    drive(grid, TopologyBuilder(), way()[:5], 0)
    path = str(tmp_path / 'a')
    wall = np.array([[1.0, 2.0], [3.0, 4.0]])
    edits = MapEdits(KeepOut().with_area(wall, is_wall=True))
    assert '.edits.npz' in save_grid(path, grid, edits=edits)
    area = load_edits(path).keep_out.areas[0]
    assert area.is_wall and np.array_equal(area.corners, wall)
    save_grid(path, grid)
    assert not load_edits(path) and (tmp_path / 'a.edits.npz.old').exists()
    assert not load_edits(str(tmp_path / 'none'))


@pytest.mark.parametrize('path', ['', '.', '/', '.yaml', 'a\0b'])
def test_what_names_no_session(path: str) -> None:
    with pytest.raises(InputError, match='expected the path'):
        stem_of(path)


def test_a_map_is_read_where_there_is_no_saved_grid_and_only_there(tmp_path: Path) -> None:
    grid = OccupancyGrid(PAPER_GRID)
    drive(grid, TopologyBuilder(), way()[:5], 0)
    write_map(tmp_path / 'a', grid.known_area())
    assert (
        load_grid(str(tmp_path / 'a')).known_area().occupied.sum()
        == grid.known_area().occupied.sum()
        > 50
    )
    other = load_grid(str(tmp_path / 'a.yaml'), OccupancyConfig(resolution_m=0.05))
    assert other.frame.resolution == grid.frame.resolution
    with pytest.raises(InputError, match=r'a.grid.npz: No such file'):
        load_grid(str(tmp_path / 'a.grid.npz'))
    (tmp_path / 'a.grid.npz').write_bytes(b'no archive')
    with pytest.raises(InputError, match=r'a.grid.npz: .*expected a saved grid'):
        load_grid(str(tmp_path / 'a'))
    with pytest.raises(InputError, match=r'neither b.grid.npz nor b.yaml'):
        load_grid(str(tmp_path / 'b'))


@pytest.mark.parametrize(
    'wrong', [{'frame': np.array([0.0, np.nan, 0.1])}, {'tiles': np.zeros((0, 2))}]
)
def test_a_grid_of_nonsense_is_refused(wrong: dict[str, Array]) -> None:
    with pytest.raises(InputError, match=r'saved grid: (frame|tiles).*: expected'):
        OccupancyGrid.from_state(OccupancyGrid(PAPER_GRID).state() | wrong)


def test_a_corrected_past_moves_the_nodes_and_they_keep_their_ids() -> None:
    """A heading error that grows with the path, then a loop closure."""
    world = building()
    poses = way()
    believed = [pose(T[0] + 0.004 * k, T[1] + 0.002 * k, T[2]) for k, T in enumerate(poses)]
    drifted = OccupancyGrid(PAPER_GRID)
    corrected = OccupancyGrid(PAPER_GRID)
    builder = TopologyBuilder()
    straight = TopologyBuilder()
    laser = LaserScanner(LaserScannerConfig(), 0)
    for k, (T, wrong) in enumerate(zip(poses, believed, strict=True)):
        scan = laser.scan(world, T, k)
        drifted.add_scan(scan, wrong)
        corrected.add_scan(scan, T)
        builder.update(drifted.window(wrong[0], wrong[1], 10.0), wrong)
        straight.update(corrected.window(T[0], T[1], 10.0), T)
    before = dict(builder.map.nodes)
    builder = builder.rebuilt(corrected.known_area(), np.array(believed), np.array(poses))
    after = builder.map
    wanted = straight.map
    places = np.array([node.position for node in wanted.nodes.values()])
    near = [np.hypot(*(places - node.position).T).min() <= 0.5 for node in after.nodes.values()]
    assert np.mean(near) >= 0.8
    assert len(after.edges) - len(after.nodes) == len(wanted.edges) - len(wanted.nodes)
    kept = before.keys() & after.nodes.keys()
    assert len(kept) >= len(after.nodes) / 2
    # Ids of nodes that a correction has removed are not reused.
    shift = [np.hypot(*(after.nodes[k].position - before[k].position)) for k in kept]
    assert max(shift) <= 2.0
    builder.update(corrected.window(poses[-1][0], poses[-1][1], 10.0), poses[-1])


def test_a_correction_before_the_first_window() -> None:
    nowhere = np.empty((0, 3))
    rebuilt = TopologyBuilder().rebuilt(OccupancyGrid(PAPER_GRID).known_area(), nowhere, nowhere)
    assert not rebuilt.map.nodes


def test_what_an_exploration_learned_is_the_same_after_a_start(tmp_path):
    explorer = Explorer()
    stem = str(tmp_path / 'room')
    assert EXPLORATION.load_optional(stem) is None
    seen = np.full((60, 60), -1, dtype=np.int8)
    seen[:40, :40] = 0
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), seen)
    scan = Scan.create(0, np.full(181, np.inf), -1.57, math.radians(1.0), 0.05, 8.0)
    explorer.step(TopologicalMap(), patch, scan, pose(2.0, 2.0, 0.0))
    EXPLORATION.save(stem, explorer)
    again = EXPLORATION.load_optional(stem)
    assert again is not None
    saved = explorer.state()
    assert len(saved['places'])
    assert all((again.state()[name] == array).all() for name, array in saved.items())
    (tmp_path / 'room.exploration.npz').write_bytes(b'no archive')
    with pytest.raises(InputError, match=r'room\.exploration\.npz'):
        EXPLORATION.load_optional(stem)
    assert 'room.exploration.npz.old' in EXPLORATION.archive(stem)
    assert EXPLORATION.load_optional(stem) is None


def mapped():
    """What each part has of a robot that has driven a little, and what it has at first."""
    poses = way()[:30]
    laser = LaserScanner(LaserScannerConfig(), 1)
    scans = [laser.scan(building(), T, k) for k, T in enumerate(poses)]
    grid = OccupancyGrid(PAPER_GRID)
    builder = TopologyBuilder()
    drive(grid, builder, poses, seed=1)
    localizer = Localizer()
    for scan, T in zip(scans, poses, strict=True):
        localizer.step(scan, T)
    explorer = Explorer()
    explorer.step(builder.map, grid.known_area(), scans[-1], poses[-1])
    return {
        'grid': (save_grid, grid, OccupancyGrid(PAPER_GRID)),
        'topology': (TOPOLOGY.save, builder, TopologyBuilder()),
        'localizer': (save_localizer, localizer, Localizer()),
        'exploration': (EXPLORATION.save, explorer, Explorer()),
    }


def test_nothing_replaces_something_unless_that_is_wanted(tmp_path):
    stem = str(tmp_path / 'floor')
    values = mapped()
    for part in (GRID, TOPOLOGY, LOCALIZER, EXPLORATION):
        save, full, empty = values[part.name]
        save(stem, empty)
        save(stem, empty)
        save(stem, full)
        files = {path: path.read_bytes() for path in tmp_path.iterdir()}
        said = f'floor{part.ending}: exists, and {part.node} has nothing to save yet: expected'
        with pytest.raises(InputError, match=said) as refused:
            save(stem, empty)
        assert '\n' not in str(refused.value)
        assert {path: path.read_bytes() for path in tmp_path.iterdir()} == files
        save(stem, full)
        # One of another version, which cannot be read, may hold anything.
        part.file(stem).write_bytes(b'of another version')
        with pytest.raises(InputError, match=said):
            save(stem, empty)
        save(stem, empty, overwrite=True)
        save(stem, empty)


def test_the_part_of_the_localizer_is_loaded_archived_or_rejected(tmp_path):
    stem = str(tmp_path / 'office')
    assert LOCALIZER.load_optional(stem) is None
    localizer = Localizer()
    world = building()
    laser = LaserScanner(LaserScannerConfig(), 1)
    for k in range(30):
        T = pose(3.0 + 0.1 * k, 6.0, 0.0)
        localizer.step(laser.scan(world, T, k), T)
    LOCALIZER.save(stem, localizer)
    loaded = LOCALIZER.load_optional(stem)
    assert loaded is not None
    for name, value in localizer.state().items():
        if name != 'points':
            np.testing.assert_array_equal(loaded.state()[name], value)
    (tmp_path / 'bad.slam.npz').write_bytes(b'nothing')
    with pytest.raises(InputError, match=r'bad\.slam\.npz: .*expected'):
        LOCALIZER.load_optional(str(tmp_path / 'bad'))
    assert 'office.slam.npz.old' in LOCALIZER.archive(stem)
    assert LOCALIZER.load_optional(stem) is None


def named(tag: str) -> LocalizerConfig:
    return LocalizerConfig(map_tag=tag)


def test_the_tag_of_a_storey_is_saved_with_the_map(tmp_path: Path) -> None:
    stem = str(tmp_path / 'tagged')
    save_localizer(stem, Localizer(named('floor 2')))
    assert load_tag(stem) == 'floor 2'
    loaded = [load_localizer(stem, named(tag)) for tag in ('', 'floor 2')]
    loaded.append(load_localizer(stem, LocalizerConfig(mode=LOCALIZATION)))
    assert [each.map_tag for each in loaded if isinstance(each, Localizer)] == 3 * ['floor 2']
    with pytest.raises(InputError, match=r"map_tag = 'floor 1': the map is of 'floor 2': expect"):
        load_localizer(stem, named('floor 1'))


def test_a_session_without_a_tag_holds_what_it_held_before_there_were_tags(tmp_path: Path) -> None:
    stem = str(tmp_path / 'plain')
    save_localizer(stem, Localizer())
    with np.load(LOCALIZER.file(stem)) as arrays:
        assert 'map_tag' not in arrays
    assert load_tag(stem) == ''
    localizer = load_localizer(stem, named('floor 1'))
    assert isinstance(localizer, Localizer)
    assert localizer.map_tag == 'floor 1'


def test_a_map_of_any_program_has_the_tag_of_its_yaml_file(tmp_path: Path) -> None:
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), np.zeros((4, 5), dtype=np.int8))
    path = str(write_map(tmp_path / 'foreign', patch))
    assert load_tag(path) == ''
    with Path(path).open('a', encoding='utf-8') as stream:
        stream.write('map_tag: 2\n')
    assert load_tag(path) == '2'
    localizer = load_localizer(path, LocalizerConfig())
    assert isinstance(localizer, Localizer)
    assert localizer.map_tag == '2'
    with pytest.raises(InputError, match="map_tag = '3': the map is of '2'"):
        load_localizer(path, named('3'))


@pytest.mark.parametrize('tag', ['x' * 65, ' 2', 'a\nb'])
def test_a_text_that_is_no_tag_is_refused(tmp_path: Path, tag: str) -> None:
    with pytest.raises(InputError, match=r'map_tag = .*expected at most 64 printable characters'):
        Localizer(named(tag))
    state = Localizer().state() | {'map_tag': np.frombuffer(tag.encode(), dtype=np.uint8)}
    with pytest.raises(InputError, match=r'map_tag of the map = .*expected at most 64'):
        Localizer.from_state(state)


def test_a_saved_tag_that_is_no_text_is_refused() -> None:
    state = Localizer().state() | {'map_tag': np.array([255, 254], dtype=np.uint8)}
    with pytest.raises(InputError, match=r'saved state: map_tag: .*expected UTF-8'):
        Localizer.from_state(state)
