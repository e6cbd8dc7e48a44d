"""Parameters of running nodes: changes are accepted, or rejected with a reason."""

import subprocess
import sys

import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParametersAtomically

pytestmark = pytest.mark.live


def value(number):
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
    graph.start('navigator')
    names = ('controller.max_speed_m_s', 'controller.max_angular_speed_rad_s')
    speed, turn = names
    assert change(graph, 'navigator', **{speed: 0.5, turn: 0.7}).successful
    assert current(graph, 'navigator', *names) == [0.5, 0.7]
    graph.until(
        lambda: f'changed: {speed} = 0.5, {turn} = 0.7' in graph.log('navigator'), 'a report'
    )
    # All or none, with a reason; NaN is in no range.
    for wrong in (-1.0, 1e9, float('nan'), float('inf')):
        result = change(graph, 'navigator', **{turn: 0.9, speed: wrong})
        assert not result.successful and 'max_speed_m_s' in result.reason, result
    assert current(graph, 'navigator', *names) == [0.5, 0.7]
    request = SetParametersAtomically.Request(
        parameters=[Parameter(name='map_frame', value=value(1.0))]
    )
    assert not graph.call(
        SetParametersAtomically, '/navigator/set_parameters_atomically', request
    ).result.successful
    assert graph.stop('navigator') == 0


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
    assert graph.stop('grid_mapper') == 0


@pytest.mark.parametrize(
    ('arguments', 'said'),
    [
        (['--params-file', '/nowhere.yaml'], '/nowhere.yaml'),
        (['-p', 'robot_radius_m:=[1'], 'robot_radius_m:=[1'),
        (['-r', 'scan'], '-r scan'),
    ],
)
def test_arguments_that_ros_cannot_read_end_the_start_with_a_line(arguments, said):
    command = [sys.executable, '-m', 'thinmap_ros.nodes.navigator', '--ros-args', *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    line = done.stderr.splitlines()[-1]  # after one of rcl's log
    assert 'Traceback' not in done.stderr
    assert line.startswith('error: arguments after --ros-args: ')
    assert said in line
