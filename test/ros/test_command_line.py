"""What is given after --ros-args: the last value counts, and a mistake is named in one line."""

import sys

import pytest
import rclpy
from rclpy.node import Node
from support.forks import forked
from support.node_list import ROOT

from thinmap_ros.core.errors import InputError
from thinmap_ros.ros.node_main import init_ros
from thinmap_ros.ros.parameters import translate

pytestmark = [pytest.mark.live, pytest.mark.usefixtures('ros_domain')]
PRESETS = sorted((ROOT / 'config').glob('*/*.yaml'))
# Of those that presets set, and of others; as typed, and as read.
VALUES = {
    'controller.max_speed_m_s': ('0.1', 0.1),
    'stop_radius_m': ('1e-1', 0.1),
    'enable_stamped_cmd_vel': ('no', False),
    'robot_radius_m': ('0.31', 0.31),
    'max_range_m': ('7.5', 7.5),
    'laser_range_noise_m': ('.03', 0.03),
    'base_frame': ('base', 'base'),
    'zero_is_no_return': ('true', True),
    'no_return_clear_range_m': ('2', 2),
    'lines.bearing_noise_rad': ('0.02', 0.02),
}
NODES = ('navigator', 'localizer', 'grid_mapper', 'web')


@pytest.fixture
def given(monkeypatch):
    """Values that a node was given by the words after --ros-args."""

    def read(name, *words):
        monkeypatch.setattr(sys, 'argv', ['node', '--ros-args', *words])
        init_ros(sys.argv)
        try:
            node = Node(name)
            translate(node, name)
            values = {n: p.value for n, p in node._parameter_overrides.items()}
            node.destroy_node()
            return values
        finally:
            rclpy.shutdown()

    return read


@pytest.mark.parametrize('preset', PRESETS, ids=lambda path: path.stem)
def test_what_follows_a_preset_overrides_it(given, preset):
    rules = [word for name, (text, _) in VALUES.items() for word in ('-p', f'{name}:={text}')]
    wanted = {name: value for name, (_, value) in VALUES.items()}
    for node in NODES:
        values = given(node, '--params-file', str(preset), *rules)
        assert {name: values[name] for name in VALUES} == wanted


def test_values_count_in_the_order_of_the_command_line(given, tmp_path):
    own = tmp_path / 'own.yaml'
    own.write_text('/**:\n  ros__parameters: {x: 1, y: 1}\n/**/one:\n  ros__parameters: {x: 2}\n')
    everyone = tmp_path / 'everyone.yaml'
    everyone.write_text('/**:\n  ros__parameters: {x: 3}\n')
    of_own = ('--params-file', str(own))
    of_all = ('--params-file', str(everyone))
    assert given('one', *of_own) == {'x': 2, 'y': 1}
    assert given('one', *of_own, *of_all)['x'] == 3
    assert given('one', *of_all, *of_own)['x'] == 2
    assert given('one', '-p', 'x:=4', *of_own)['x'] == 2
    assert given('one', *of_own, '-p', 'x:=4') == {'x': 4, 'y': 1}
    assert given('one', *of_own, '-p', 'x:=4', '--ros-args', '--param', 'x:=5')['x'] == 5
    assert given('one', *of_own, '-p', 'one:x:=4', '-p', 'other:x:=5')['x'] == 4
    # In a namespace, and under another name.
    assert given('one', *of_own, '-r', '__ns:=/robot', '-p', 'x:=4')['x'] == 4
    assert given('one', *of_own, '-r', '__node:=two', '-p', 'x:=4', '-p', 'two:y:=6') == {
        'x': 4,
        'y': 6,
    }


WRONG = [
    ('-p robot_radius_m=0.2', '(did you mean robot_radius_m:=0.2?): expected NAME:=VALUE'),
    ('-p x', 'expected NAME:=VALUE'),
    ('-p x:=', "-p 'x:=': no value: expected NAME:=VALUE"),
    ('-p x:={a', "-p 'x:={a': "),
    ('-p 1x:=1', "'-p 1x:=1'"),
    ('-p x:=[1,2.0]', "'-p x:=[1,2.0]'"),
    ('-p', 'trailing -p flag'),
    ('-r x=y', "-r 'x=y' (did you mean x:=y?): expected FROM:=TO"),
    ('-r __ns:=bad', "'-r __ns:=bad'"),
    ('--remap', 'trailing --remap flag'),
    ('--params-file nothere.yaml', "--params-file 'nothere.yaml': no such file"),
    ('--params-file FOLDER', 'no such file'),
    ('--params-file EMPTY', 'expected a parameter file: '),
    ('--params-file LIST', 'expected a parameter file: '),
    ('--params-file BROKEN', 'expected a parameter file: '),
    ('--params-file', 'trailing --params-file flag'),
    ('--log-level nonsense', "'--log-level nonsense'"),
    ('--nonsense', "unknown: ['--nonsense']"),
    ('-e enclave', 'Enclave name is not valid'),
]


@pytest.mark.parametrize(('words', 'said'), WRONG, ids=[words for words, _ in WRONG])
def test_a_mistake_is_one_line_that_names_it(tmp_path, capfd, words, said):
    for name, text in (('EMPTY', ''), ('LIST', '- 1\n'), ('BROKEN', 'a: [\n')):
        (tmp_path / name).write_text(text)
        words = words.replace(name, str(tmp_path / name))
    words = words.replace('FOLDER', str(tmp_path))
    with pytest.raises(InputError) as error:
        init_ros(['node', '--ros-args', *words.split()])
    assert said in str(error.value) and '\n' not in str(error.value)
    assert '/src/' not in str(error.value), 'files of ROS'
    assert capfd.readouterr().err == ''


@pytest.mark.parametrize(
    ('module', 'words', 'said'),
    [
        ('thinmap', ['--ros-args', '--params-file', 'nothere.yaml'], "'nothere.yaml': no such"),
        ('thinmap', ['--ros-args', '-p', 'robot_radius_m=0.2'], 'did you mean'),
        ('thinmap', ['robot_radius_m:=0.2'], 'expected --ros-args -p robot_radius_m:=0.2 or'),
        ('thinmap', ['web:=yes'], 'expected web:=true or web:=false'),
        ('markers', ['map_frame:=x', '--ros-args'], 'expected --ros-args -p map_frame:=x or'),
        ('markers', ['all'], "'all': expected arguments after --ros-args"),
    ],
)
def test_a_node_ends_with_one_line(module, words, said):
    done = forked.run(f'thinmap_ros.nodes.{module}', *words)
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2
    assert line.startswith('error: ') and said in line
