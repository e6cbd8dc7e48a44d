"""Values of wrong types at the public names: one line that names the value, of a ThinmapError."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.slam_room import ROOM, scan_in

import thinmap_ros
from thinmap_ros import (
    ExplorationOptions,
    Explorer,
    ExplorerConfig,
    GlobalLocalizer,
    GridFrame,
    GridPatch,
    LaserConfig,
    LocalizerConfig,
    OccupancyConfig,
    OccupancyGrid,
    Pipeline,
    PipelineConfig,
    Scan,
    ThinmapError,
    TopologicalMap,
    TopologyConfig,
    World,
    build_topology,
    evaluate,
    explore,
    merge_maps,
    open_log,
    paired_scans,
    plot,
    read_map,
    read_world,
    shortest_path,
    thin,
    topology_from_msg,
    world_path,
    write_graph,
    write_map,
    write_trajectory,
)

FRAME = GridFrame(0.0, 0.0, 0.05)
PATCH = GridPatch(FRAME, np.zeros((20, 20), dtype=np.int8))
GRAPH = build_topology(PATCH, None, TopologyConfig(robot_radius_m=0.1))
WORLD = World.from_patch('room', PATCH, np.zeros(3))
HERE = np.array([2.0, 2.0, 0.0])
SCAN = scan_in(ROOM, HERE)
POSES = (np.arange(5), np.zeros((5, 3)))
WRONG: list[tuple[str, Callable[[], object]]] = [
    ('config = 3', lambda: Pipeline(3)),
    ("resolution_m = '5 cm'", lambda: Pipeline(resolution_m='5 cm')),
    ('resolution_m = 0', lambda: Pipeline(resolution_m=0)),
    ('max_range_m = -1', lambda: Pipeline(max_range_m=-1)),
    ('resolution = 0.1 (did you mean resolution_m?)', lambda: Pipeline(resolution=0.1)),
    ('scan = 3', lambda: Pipeline().step(3, HERE)),
    ('T_odom_base = ', lambda: Pipeline().step(SCAN, [0.0, 0.0])),
    ("T_odom_base = 'here'", lambda: Pipeline().step(SCAN, 'here')),
    ('T_odom_base = ', lambda: Pipeline().step(SCAN, np.array([0.0, np.nan, 0.0]))),
    ('localizer = 3', lambda: PipelineConfig(localizer=3)),
    ('grid = TopologyConfig', lambda: PipelineConfig(grid=TopologyConfig())),
    ("scans_per_graph = 'all'", lambda: PipelineConfig(scans_per_graph='all')),
    ("lost_threshold = 'x'", lambda: LocalizerConfig(lost_threshold='x')),
    ('matching = None', lambda: LocalizerConfig(matching=None)),
    ("max_range_m = 'far'", lambda: LaserConfig(max_range_m='far')),
    ("p_hit = 'x'", lambda: OccupancyConfig(p_hit='x')),
    ("robot_radius_m = 'x'", lambda: TopologyConfig(robot_radius_m='x')),
    ('probability_threshold = None', lambda: ExplorerConfig(probability_threshold=None)),
    ('plot: a int', lambda: plot(3)),
    ("layers: 'grap' (did you mean graph?)", lambda: plot(PATCH, layers=['grap'])),
    ('layers: 3', lambda: plot(PATCH, layers=3)),
    ('size_in = 0', lambda: plot(PATCH, size_in=0)),
    ("size_in = 'big'", lambda: plot(PATCH, size_in='big')),
    ('true = [1.0, 2.0]', lambda: plot(PATCH, true=[1.0, 2.0])),
    ('size = 3 (did you mean size_in?)', lambda: plot(PATCH, size=3)),
    ('topology = 3', lambda: plot(PATCH, 3)),
    ('scan: could not convert', lambda: Scan.create(0, ['x'], 0.0, 0.1, 0.1, 8.0)),
    ('angles nan', lambda: Scan.create(0, [1.0], None, 0.1, 0.1, 8.0)),
    ('laser mounted at', lambda: Scan.create(0, [1.0], 0.0, 0.1, 0.1, 8.0, [1.0, 2.0])),
    ('path = 3', lambda: open_log(3)),
    ('config = 3', lambda: open_log('x', 3)),
    ("T_base_laser = 'front'", lambda: open_log('x', T_base_laser='front')),
    ("log = 'x.mcap'", lambda: list(paired_scans('x.mcap'))),
    ("resolution = '5 cm'", lambda: GridFrame(0.0, 0.0, '5 cm')),
    ('frame = None', lambda: GridPatch(None, PATCH.cells)),
    ('cells = ', lambda: GridPatch(FRAME, [[0]])),
    ('cells = ', lambda: GridPatch(FRAME, np.zeros(3, dtype=np.int8))),
    ('config = 0.05', lambda: OccupancyGrid(0.05)),
    ('scan = 3', lambda: OccupancyGrid().add_scan(3, HERE)),
    ('T_map_base = 3', lambda: OccupancyGrid().add_scan(SCAN, 3)),
    ('patch = 3', lambda: OccupancyGrid.from_patch(3)),
    ('path = None', lambda: read_map(None)),
    ('x.pgm: an image', lambda: read_map('x.pgm')),
    ('path = 3', lambda: write_map(3, PATCH)),
    ('patch = 3', lambda: write_map('x', 3)),
    ("paths = 'maps'", lambda: merge_maps('maps')),
    ('path = 1', lambda: merge_maps([1, 2])),
    ('expected nodes', lambda: TopologicalMap([3])),
    ('patch = 3', lambda: build_topology(3)),
    ('seed_xy = 3', lambda: build_topology(PATCH, 3)),
    ('config = 0.2', lambda: build_topology(PATCH, None, 0.2)),
    ('topology = 3', lambda: shortest_path(3, 1, 2)),
    ("x, y = 'here'", lambda: GRAPH.nearest_node('here')),
    ("x, y = ('a', 'b')", lambda: GRAPH.nearest_node('a', 'b')),
    ('node 999: ', lambda: shortest_path(GRAPH, 999, 999)),
    ("node = '1'", lambda: shortest_path(GRAPH, '1', '2')),
    ("free = array('free'", lambda: thin('free')),
    ('free = ', lambda: thin(np.ones(5, dtype=np.bool_))),
    ('topological map without', lambda: topology_from_msg(3)),
    ('path = 3', lambda: write_graph(3, GRAPH)),
    ('topology = 3', lambda: write_graph('x.geojson', 3)),
    ('patch = 3', lambda: GlobalLocalizer(3, GRAPH)),
    ('topology = 3', lambda: GlobalLocalizer(PATCH, 3)),
    ('config = 3', lambda: Explorer(3)),
    ('patch = 3', lambda: World.from_patch('room', 3, np.zeros(3))),
    ('start = 3', lambda: World.from_patch('room', PATCH, 3)),
    ('world = 3', lambda: explore(3, np.zeros(3))),
    ("world 'room_10' (did you mean room_10x10?)", lambda: explore('room_10')),
    ('option = 3 (did you mean options?)', lambda: explore(WORLD, option=3)),
    ("start = 'here'", lambda: explore(WORLD, 'here')),
    ('config = 3', lambda: explore(WORLD, np.zeros(3), 3)),
    ('speed = 1 (did you mean speed_m_s?)', lambda: ExplorationOptions(speed=1)),
    ("robot = 'r2d2'", lambda: ExplorationOptions(robot='r2d2')),
    ("localization = 'gps'", lambda: ExplorationOptions(localization='gps')),
    ("speed_m_s = 'fast'", lambda: ExplorationOptions(speed_m_s='fast')),
    ("kidnap_at_s = 'soon'", lambda: ExplorationOptions(kidnap_at_s='soon')),
    ('laser = 3', lambda: ExplorationOptions(laser=3)),
    ('path = 3', lambda: read_world(3)),
    ('path = 3', lambda: world_path(3)),
    ('trajectory = Pipeline(', lambda: write_trajectory('x.tum', Pipeline())),
    ('trajectory = ', lambda: write_trajectory('x.tum', ([1, 2], np.zeros((3, 3))))),
    ('path = 3', lambda: write_trajectory(3, POSES)),
    ('run = 3', lambda: evaluate(3, POSES)),
    ('run = ', lambda: evaluate((1, 2, 3), POSES)),
    ('reference = 3', lambda: evaluate(POSES, 3)),
    ('truth.txt: ', lambda: evaluate(POSES, 'truth.txt')),
    ('live: 0 stamps', lambda: evaluate(Pipeline(), POSES)),
    ("delta = '1'", lambda: evaluate(POSES, POSES, delta='1')),
    ('max_difference = 1 (did you', lambda: evaluate(POSES, POSES, max_difference=1)),
]
# Values that others make, and what reports errors.
_MADE_BY_OTHERS = {
    'MergedMap',
    'ScanTrajectory',
    'StampedPoses',
    'ThinmapError',
    'InputError',
    'ConfigError',
}
# Configurations: `Config` checks all fields of all of them.
_CONFIGS = {name for name in thinmap_ros.__all__ if name.endswith(('Config', 'LaserOptions'))}


@pytest.mark.parametrize(('start', 'call'), WRONG)
def test_a_wrong_type_is_one_line_that_names_it(start: str, call: Callable[[], object]) -> None:
    with pytest.raises(ThinmapError) as raised:
        call()
    (line,) = str(raised.value).splitlines()
    assert start in line
    assert 'expected' in line
    assert len(line) < 400


def test_every_public_name_is_tried() -> None:
    tried = {name for _, call in WRONG for name in call.__code__.co_names}
    assert set(thinmap_ros.__all__) - tried <= _MADE_BY_OTHERS | _CONFIGS


def test_short_forms_are_those_of_the_configuration(tmp_path: Path) -> None:
    slam = Pipeline(resolution_m=0.1, max_range_m=1.0)
    assert slam.config == PipelineConfig(grid=OccupancyConfig(resolution_m=0.1))
    slam.step(SCAN, [2.0, 2.0, 0.0])
    patch = slam.grid.known_area()
    assert patch.frame.resolution == 0.1
    assert max(patch.shape) <= 22  # 1 m in all directions, and the cells at its rim
    assert Pipeline().config.grid.resolution_m == 0.05
