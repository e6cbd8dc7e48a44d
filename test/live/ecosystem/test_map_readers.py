"""The map of an office, as Nav2's static layer, AMCL, explore_lite and map_server read it."""

import numpy as np
import pytest
import yaml
from nav_msgs.msg import MapMetaData, OccupancyGrid
from nav_msgs.srv import GetMap
from PIL import Image
from support.office_mapping import Mapping
from support.peers import map_readers

from thinmap_msgs.msg import ProbabilityGrid, SlamStatus
from thinmap_msgs.srv import SaveMap
from thinmap_ros.experiments.drives import world_of
from thinmap_ros.files import occupancy_maps
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
MIN_FRONTIER_M = 0.5  # min_frontier_size of explore_lite


def test_others_read_walls_free_and_unknown_cells_of_map(graph, tmp_path):
    mapping = Mapping(graph)
    shown, exact = mapping.drive()
    cells = shown.cells
    assert shown.frame.resolution == 0.05
    walls = exact.cells >= 65
    free = (exact.cells >= 0) & (exact.cells <= 25)
    assert walls.sum() > 500 and free.sum() > 10_000
    # The robot does not see everything: there are frontiers.
    assert (exact.cells == -1).sum() > 100

    costs = map_readers.static_layer(cells)
    assert (costs[walls] == map_readers.LETHAL).all()
    assert (costs[free] == map_readers.FREE_SPACE).all()
    assert (costs[~walls & ~free] == map_readers.NO_INFORMATION).all()
    assert not (map_readers.static_layer(exact.cells) == map_readers.LETHAL).any()

    amcl = map_readers.amcl_map(cells)
    assert (
        (amcl[walls] == 1).all() and (amcl[free] == -1).all() and (amcl[~walls & ~free] == 0).all()
    )

    start = tuple(shown.frame.cells_of(mapping.samples[-1].T_world_base[None, :2])[0].tolist())
    least = round(MIN_FRONTIER_M / shown.frame.resolution)
    expected = map_readers.slam_toolbox_map(exact.cells)
    found, wanted = (
        map_readers.explore_lite_frontiers(map_readers.explore_lite_costs(each), start, least)
        for each in (cells, expected)
    )
    assert found and set().union(*found) == set().union(*wanted)
    assert sorted(map(len, found)) == sorted(map(len, wanted))

    assert_near_true_walls(shown)
    assert_files_agree(graph, tmp_path, mapping, shown)
    assert graph.stop('grid_mapper') == 0


def assert_near_true_walls(shown):
    """Lethal cells are on walls of the office: within 0.1 m of an obstacle."""
    world = world_of('office')
    at = world.frame.cells_of(shown.frame.centres_of(np.argwhere(shown.cells == 100)))
    inside = ((at >= 0) & (at < world.occupied.shape)).all(axis=1)
    at = at[inside]
    off_m = world.distance_to_wall_m[at[:, 0], at[:, 1]]
    assert inside.mean() > 0.9 and (off_m <= 0.1).mean() > 0.98


def assert_files_agree(graph, tmp_path, mapping, shown):
    """A saved map has the cells of /map in map_server, and the pixels that map_saver writes."""
    stem = tmp_path / 'office'
    response = graph.call(SaveMap, 'save_map', SaveMap.Request(path=str(stem)))
    assert response.success, response.message
    loaded, description = map_readers.map_server_cells(stem.with_suffix('.yaml'))
    np.testing.assert_array_equal(loaded, shown.cells)
    assert description['resolution'] == pytest.approx(mapping.maps[-1].info.resolution)
    np.testing.assert_array_equal(
        np.asarray(Image.open(stem.with_suffix('.pgm'))), map_readers.map_saver_image(shown.cells)
    )
    np.testing.assert_array_equal(
        occupancy_maps.read_map(stem.with_suffix('.yaml')).cells, shown.cells
    )


@pytest.mark.parametrize('free_thresh', [0.25, 0.196])
def test_a_map_that_map_saver_wrote_has_the_cells_that_map_server_gives_it(tmp_path, free_thresh):
    cells = np.random.default_rng(1).choice(np.array([-1, 0, 100], dtype=np.int8), (40, 30))
    Image.fromarray(map_readers.map_saver_image(cells, free_thresh)).save(tmp_path / 'm.pgm')
    path = tmp_path / 'm.yaml'
    path.write_text(
        yaml.safe_dump(
            {
                'image': 'm.pgm',
                'mode': 'trinary',
                'resolution': 0.05,
                'origin': [-1.0, -2.0, 0.0],
                'negate': 0,
                'occupied_thresh': 0.65,
                'free_thresh': free_thresh,
            }
        )
    )
    expected, _ = map_readers.map_server_cells(path)
    read = occupancy_maps.read_map(path).cells
    np.testing.assert_array_equal(read, expected)
    # With 0.25, map_server takes unknown pixels as free.
    assert np.array_equal(expected, cells) is (free_thresh < 0.2)


def test_nodes_say_that_unknown_cells_of_a_file_are_free(graph, tmp_path):
    cells = np.full((40, 60), -1, dtype=np.int8)
    cells[10:30, 10:30] = 0
    cells[10, 10:30] = 100
    Image.fromarray(map_readers.map_saver_image(cells)).save(tmp_path / 'm.pgm')
    path = tmp_path / 'm.yaml'
    path.write_text('image: m.pgm\nresolution: 5e-2\norigin: [0, 0, 0]\nfree_thresh: .25\n')
    graph.start('localizer', mode='localization', map_file_name=str(path))
    graph.start('global_localizer', map_path=str(path))
    graph.start('grid_mapper', session_path=str(tmp_path / 'm'))
    for node in graph.processes:
        line = f'{path}: 2000 cells of grey 205, which map_saver writes for unknown, are free'
        graph.until(lambda name=node, text=line: text in graph.log(name), f'a line of {node}')


def test_services_metadata_and_late_subscribers_have_the_present_map(graph):
    mapping = Mapping(graph, map_values='probability', map_update_interval=0.3)
    shown, exact = mapping.drive()
    np.testing.assert_array_equal(shown.cells, exact.cells)
    for name in ('map', 'dynamic_map'):
        answer = graph.call(GetMap, name, GetMap.Request()).map
        assert answer == mapping.maps[-1]
    late_maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    late_grids = graph.heard('grid', ProbabilityGrid, qos.LATCHED)
    metadata = graph.heard('map_metadata', MapMetaData, qos.LATCHED)
    graph.until(lambda: late_maps and late_grids and metadata, 'latched maps')
    assert late_maps[0] == mapping.maps[-1]
    assert metadata[0] == mapping.maps[-1].info
    assert late_grids[0].data == mapping.grids[-1].data
    # The load time is that of the start: it does not change with scans.
    assert len({m.info.map_load_time.sec for m in mapping.maps}) == 1
    assert mapping.maps[-1].info.map_load_time.sec > mapping.maps[-1].header.stamp.sec
    assert graph.stop('grid_mapper') == 0


def test_scans_of_a_lost_robot_are_not_mapped(graph):
    mapping = Mapping(graph)

    def add(sample, state):
        before = len(mapping.windows)
        mapping.publish(sample, state)
        graph.until(lambda: len(mapping.windows) > before, 'a window')
        return messages.grid_from_msg(mapping.windows[-1].grid)

    lost, no_map, tracked, lost_again = mapping.samples[:4]
    assert (add(lost, SlamStatus.LOST).cells == -1).all()
    assert (add(no_map, SlamStatus.NO_MAP).cells == -1).all()
    first = add(tracked, SlamStatus.TRACKING)
    assert first.occupied.any() and (first.cells < 50).any()
    second = add(lost_again, SlamStatus.LOST)
    assert (second.cells >= 0).sum() == (first.cells >= 0).sum()
    assert graph.stop('grid_mapper') == 0
