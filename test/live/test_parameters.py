"""Parameters of running nodes: changes are accepted, or rejected with a reason."""

import pytest
from geometry_msgs.msg import Twist
from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    SetParameters,
    SetParametersAtomically,
)
from support.forks import forked
from support.timeouts import PATIENCE_S

from thinmap_msgs.msg import LocalGrid, SlamStatus
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live


def value(number):
    if isinstance(number, bool):
        return ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=number)
    if isinstance(number, str):
        return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=number)
    return ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=number)


def change(graph, node, **values):
    request = SetParametersAtomically.Request(
        parameters=[Parameter(name=name, value=value(number)) for name, number in values.items()]
    )
    return graph.call(SetParametersAtomically, f'/{node}/set_parameters_atomically', request).result


def current(graph, node, *names):
    answer = graph.call(
        GetParameters, f'/{node}/get_parameters', GetParameters.Request(names=names)
    )
    return [found.double_value for found in answer.values]


def test_the_navigator_changes_its_speed_and_refuses_what_makes_no_sense(graph):
    graph.start('navigator', **{'controller.max_speed_m_s': 0.5})
    names = ('controller.max_speed_m_s', 'controller.max_angular_speed_rad_s')
    speed, turn = names
    assert change(graph, 'navigator', **{speed: 0.4, turn: 0.7}).successful
    assert current(graph, 'navigator', *names) == [0.4, 0.7]
    graph.until(
        lambda: f'changed: {speed} = 0.4, {turn} = 0.7' in graph.log('navigator'), 'a report'
    )
    # All or none, with a reason; NaN is in no range.
    for wrong in (-1.0, 1e9, float('nan'), float('inf')):
        result = change(graph, 'navigator', **{turn: 0.9, speed: wrong})
        assert not result.successful and 'max_speed_m_s' in result.reason, result
    assert current(graph, 'navigator', *names) == [0.4, 0.7]
    # A peer cannot make the robot faster or thinner than it was started; it can undo its changes.
    for name, unsafe, start in (
        (speed, 5.0, 0.5),
        (turn, 3.0, 1.0),
        ('controller.max_acceleration_m_s2', 10.0, 0.4),
        ('robot_radius_m', 0.0, 0.25),
        ('stop_radius_m', 0.0, 0.24),
        ('reaction_time_s', 0.0, 0.3),
    ):
        result = change(graph, 'navigator', **{name: unsafe})
        assert not result.successful
        assert f'{name} = {unsafe}: expected' in result.reason and str(start) in result.reason
        assert change(graph, 'navigator', **{name: start}).successful
    request = SetParametersAtomically.Request(
        parameters=[Parameter(name='map_frame', value=value(1.0))]
    )
    assert not graph.call(
        SetParametersAtomically, '/navigator/set_parameters_atomically', request
    ).result.successful
    assert graph.stop('navigator') == 0


def test_localizer_and_grid_mapper_keep_their_map_while_parameters_change(graph):
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    windows = graph.heard('local_grid', LocalGrid, qos.LATCHED)
    states = graph.heard('slam_status', SlamStatus)
    start = {'initial_x_m': 2.0, 'initial_y_m': 2.0}
    graph.start('localizer', use_sim_time=True, **start)
    graph.start('grid_mapper', use_sim_time=True, map_update_interval=3600.0)
    # Time waits for the mapper, as scans are lost where a busy machine is late.
    graph.start(
        'sim',
        start='2.0,2.0,0.0',
        real_time_factor=4.0,
        lockstep='local_grid',
        wait_for_subscribers=1,
    )
    graph.until(lambda: len(states) > 5 and len(windows) > 2, 'tracking and mapping')
    assert not maps

    # The map comes at once, and with its new values.
    assert change(graph, 'grid_mapper', map_values='probability').successful
    graph.until(lambda: maps, 'a map')
    cells = set(maps[-1].data)
    assert -1 in cells and cells - {-1, 0, 100}
    assert change(graph, 'grid_mapper', map_values='trinary', map_update_interval=0.5).successful
    # A map is published when it has changed: the robot turns to a part of the room that is new.
    commands = graph.node.create_publisher(Twist, 'cmd_vel', 10)
    turn = messages.twist_msg(0.0, 0.5)
    graph.until(lambda: commands.publish(turn) or len(maps) > 3, 'maps at the new rate')
    assert set(maps[-1].data) == {-1, 0, 100}
    known = sum(cell >= 0 for cell in maps[-1].data)
    assert change(graph, 'grid_mapper', occupied_thresh=1.0, free_thresh=0.0).successful
    graph.until(lambda: sum(cell >= 0 for cell in maps[-1].data) < known, 'fewer known cells')
    result = change(graph, 'grid_mapper', occupied_thresh=0.3, free_thresh=0.4)
    assert not result.successful and 'free_thresh = 0.4' in result.reason

    names = ('lost_threshold', 'loop_closure.min_inlier_ratio', 'matching.noise_m')
    values = dict(zip(names, (8.0, 0.9, 0.06), strict=True))
    assert change(graph, 'localizer', **values).successful
    assert current(graph, 'localizer', *names) == [8.0, 0.9, 0.06]
    result = change(graph, 'localizer', lost_threshold=-1.0)
    assert not result.successful and 'lost_threshold' in result.reason
    before = len(states)
    graph.until(lambda: len(states) > before + 5, 'more poses')
    assert {status.state for status in states} == {SlamStatus.TRACKING}
    assert states[-1].inlier_ratio > 0.5, 'it matches scans with the map that it has'


def test_what_cannot_change_is_marked_and_refused(graph):
    graph.start('grid_mapper')
    request = DescribeParameters.Request(names=['resolution_m'])
    (descriptor,) = graph.call(
        DescribeParameters, '/grid_mapper/describe_parameters', request
    ).descriptors
    assert descriptor.read_only and 'Edge of a cell' in descriptor.description
    assert descriptor.floating_point_range[0].to_value == 1.0
    result = change(graph, 'grid_mapper', resolution_m=0.2)
    assert not result.successful and 'read-only' in result.reason
    # A node with a clock that nobody publishes would do nothing any more, not even stop.
    result = change(graph, 'grid_mapper', use_sim_time=True)
    assert not result.successful and 'read-only' in result.reason
    simulated = Parameter(name='use_sim_time', value=value(True))
    request = SetParameters.Request(parameters=[simulated])
    answer = graph.call(SetParameters, '/grid_mapper/set_parameters', request)
    assert [result.successful for result in answer.results] == [False]
    assert 'use_sim_time' in answer.results[0].reason
    assert graph.stop('grid_mapper') == 0


@pytest.mark.usefixtures('ros_domain')
@pytest.mark.parametrize(
    ('node', 'name', 'number'),
    [
        ('global_localizer', 'lost_timeout_s', '-1.0e+9'),
        ('global_localizer', 'lost_timeout_s', '.nan'),
        ('global_localizer', 'lost_timeout_s', '1.0e+300'),
        ('navigator', 'transform_tolerance', '.nan'),
    ],
)
def test_numbers_that_make_no_sense_end_the_start_with_a_line(node, name, number):
    words = ('--ros-args', '-p', f'{name}:={number}')
    done = forked.run(f'thinmap_ros.nodes.{node}', *words, timeout=PATIENCE_S)
    line = done.stderr.splitlines()[-1]
    assert 'Traceback' not in done.stderr
    assert done.returncode == 2 and f'{name} = ' in line and 'expected' in line


def test_a_running_global_localizer_keeps_its_parameters(graph):
    graph.start('global_localizer')
    for wrong in (-1e9, float('nan'), 1e300):
        result = change(graph, 'global_localizer', lost_timeout_s=wrong)
        assert not result.successful and result.reason
    assert current(graph, 'global_localizer', 'lost_timeout_s') == [3.0]
    assert graph.stop('global_localizer') == 0


@pytest.mark.parametrize(
    ('arguments', 'said'),
    [
        (['--params-file', 'nothere.yaml'], "error: --params-file 'nothere.yaml': no such file\n"),
        (
            ['-p', 'robot_radius_m=0.2'],
            "error: -p 'robot_radius_m=0.2' (did you mean robot_radius_m:=0.2?): "
            'expected NAME:=VALUE\n',
        ),
        (['-r', 'scan'], "error: -r 'scan': expected FROM:=TO\n"),
    ],
)
def test_a_typing_error_after_ros_args_is_one_line(arguments, said):
    done = forked.run('thinmap_ros.nodes.navigator', '--ros-args', *arguments)
    assert (done.returncode, done.stderr, done.stdout) == (2, said, '')


def test_arguments_that_ros_cannot_read_end_the_start_with_a_line():
    done = forked.run('thinmap_ros.nodes.navigator', '--ros-args', '-p', 'robot_radius_m:=[1')
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert 'Traceback' not in done.stderr
    assert line.startswith("error: -p 'robot_radius_m:=[1': ")
    assert 'robot_radius_m:=[1' in line


def test_help_is_of_the_node_and_names_its_parameters():
    done = forked.run('thinmap_ros.nodes.navigator', '--help')
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.startswith('usage: ros2 run thinmap_ros navigator ')
    assert done.stdout.endswith('config/navigator.yaml\n')
