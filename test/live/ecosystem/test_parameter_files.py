"""Parameter files of other packages start our nodes under the names that they replace."""

from pathlib import Path

import pytest
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import GetState
from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import parameter_value_to_python
from support.peers.foreign_map import write_foreign_map

from thinmap_ros.files.occupancy_maps import read_map
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
FILES = Path(__file__).resolve().parents[2] / 'docs' / 'foreign'


def start(graph, program, name, file, **values):
    """Start a program as a node of another name, with the file of that node alone."""
    text = (FILES / f'{file}.yaml').read_text()
    own = graph.folder / f'{file}.yaml'
    own.write_text(text.replace('/**:', f'{name}:'))
    arguments = ('--ros-args', '--params-file', str(own), '--')
    graph.start(program, (f'__node:={name}',), arguments, label=name, **values)


def state(graph, name):
    return graph.call(GetState, f'/{name}/get_state', GetState.Request()).current_state.id


def current(graph, name, parameter):
    request = GetParameters.Request(names=[parameter])
    (value,) = graph.call(GetParameters, f'/{name}/get_parameters', request).values
    return parameter_value_to_python(value)


def test_files_of_other_packages_start_our_nodes_under_their_names(graph, tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_STATE_HOME', str(tmp_path / 'home'))
    start(graph, 'localizer', 'slam_toolbox', 'slam_toolbox')
    start(graph, 'localizer', 'amcl', 'amcl', mode='localization')
    start(graph, 'explorer', 'explore_node', 'explore_lite')
    expected = {
        'slam_toolbox': ('keyframes.distance_m', 0.4),  # minimum_travel_distance
        'amcl': ('base_frame', 'base_footprint'),  # base_frame_id
        'explore_node': ('min_frontier_size', 0.75),
    }
    for name, (parameter, value) in expected.items():
        graph.until(lambda name=name: state(graph, name) == State.PRIMARY_STATE_ACTIVE, name)
        assert current(graph, name, parameter) == value
        assert 'ignored parameters' in graph.log(name)
    for name in expected:
        assert graph.stop(name) == 0


def test_sections_of_other_packages_are_read_under_our_names(graph):
    """A file is used as it is: with the names of the nodes that ours replace, and for Gazebo."""
    file = graph.folder / 'mapper_params.yaml'
    file.write_text(
        'slam_toolbox:\n  ros__parameters:\n    use_sim_time: true\n    scan_topic: /front/scan\n'
        '    minimum_travel_distance: 0.7\n    use_scan_matching: true\n'
        '/robot2/slam_toolbox:\n  ros__parameters: {minimum_travel_distance: 0.9}\n'
        'bt_navigator:\n  ros__parameters: {plugin_lib_names: [one]}\n'
    )
    arguments = ('--ros-args', '--params-file', str(file), '--')
    graph.start('localizer', arguments=arguments)
    graph.start('topology_builder', arguments=arguments)
    expected = {'keyframes.distance_m': 0.7, 'scan_topic': '/front/scan', 'use_sim_time': True}
    for parameter, value in expected.items():
        assert current(graph, 'localizer', parameter) == value
    ready = ('localizer', 'topology_builder')
    graph.until(lambda: all('ready' in graph.log(name) for name in ready), 'ready')
    assert 'ignored parameters that node localizer does not have: use_scan' in graph.log(
        'localizer'
    )
    assert graph.node.count_subscribers('/front/scan') == 1
    missing = f'{file}: no section for topology_builder: expected topology_builder: or /**:, found'
    assert missing in graph.log('topology_builder')
    assert 'no section' not in graph.log('localizer')
    for name in ready:
        assert graph.stop(name) == 0


def test_grid_mapper_publishes_the_map_of_map_server(graph, tmp_path):
    path = write_foreign_map(tmp_path, 'room_10x10')
    graph.start(
        'grid_mapper',
        ('__node:=map_server',),
        label='map_server',
        yaml_filename=str(path),
        mode='localization',
    )
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    graph.until(lambda: maps, 'the map')
    walls = messages.grid_from_msg(maps[-1])
    given = read_map(path)
    assert walls.frame.resolution == pytest.approx(given.frame.resolution)
    assert (walls.cells == 100).sum() == (given.cells == 100).sum() > 100
    assert (walls.cells == 0).sum() == (given.cells == 0).sum() > 1000
    assert graph.stop('map_server') == 0
