"""The small `ros2` for machines without ROS where there is nothing: its help, and its errors."""

import os
import subprocess
from pathlib import Path

import pytest
from support.ros2 import ROOT, ROS2, output, run

pytestmark = pytest.mark.live


def test_programs_and_packages_need_no_graph():
    share = Path(output('pkg', 'prefix', '--share', 'thinmap_ros').strip())
    assert (share / 'config' / 'robots' / 'turtlebot3.yaml').exists()
    assert share.is_relative_to(output('pkg', 'prefix', 'thinmap_ros').strip())
    assert 'usage: replay' in output('run', 'thinmap_ros', 'replay', '--help')


def test_help_names_what_there_is():
    text = output('-h')
    for word in ('action', 'lifecycle', 'param', 'pkg', 'run', 'service', 'topic'):
        assert f'\n  {word} ' in text
    assert 'Verbs:\n  echo ' in output('topic', '-h')
    assert '--field' in output('topic', 'echo', '-h')
    assert 'program' in output('run', '-h')


SAVE = ('service', 'call', '/save_map', 'thinmap_msgs/srv/SaveMap')
GOAL = ('action', 'send_goal', '/x', 'nav2_msgs/action/NavigateToPose')
COMMANDS = 'expected one of action, lifecycle, param, pkg, run, service, topic\n'
AT_ONCE = ('--spin-time', '0.5')


@pytest.mark.parametrize(
    ('words', 'code', 'said'),
    [
        (['bag', 'record'], 2, f'ros2 bag: not in this ros2: {COMMANDS}'),
        (['node', 'list'], 2, f'ros2 node: not in this ros2: {COMMANDS}'),
        (['security', 'create_keystore', 'x'], 2, 'needs a ROS 2 Jazzy with the package'),
        (['topic', 'info', '/scan'], 2, 'ros2 topic info: not in this ros2: expected one of echo,'),
        (['topic', 'echo'], 2, 'topic_name'),
        (['topic', 'hz', '/scan', '/odom'], 2, '/odom'),
        (['run', 'thinmap_ros'], 2, 'program'),
        (['run', 'thinmap_ros', 'pilot'], 1, 'thinmap_ros has no pilot; it has bag_player'),
        (['run', 'nowhere', 'pilot'], 1, "Package 'nowhere' not found"),
        (['pkg', 'prefix', 'nowhere'], 1, "Package 'nowhere' not found"),
        (
            [*SAVE[:-1], 'thinmap_msgs/srv/Nix'],
            1,
            "service type is invalid: 'thinmap_msgs/srv/Nix'",
        ),
        ([*SAVE[:-1], 'Nix'], 1, 'expected PACKAGE/srv/NAME'),
        ([*SAVE, '{path: [}'], 1, "not YAML: '{path: [}'"),
        ([*SAVE, 'room'], 1, "needs to be a dictionary in YAML format: 'room'"),
        ([*SAVE, '{pahts: room}'], 1, "has no 'pahts'; it has path"),
        ([*SAVE, '{path: [1]}'], 1, "SaveMap_Request.path: '[1]', expected string"),
        ([*GOAL, '{pose: {pose: {position: {x: far}}}}'], 1, "Point.x: 'far', expected double"),
        ([*GOAL, '{pose: {pose: {position: 5}}}'], 1, "Point: '5', expected a dictionary"),
        ([*GOAL, '{pose: {header: {stamp: {sec: 1.5}}}}'], 1, "sec: '1.5', expected int32"),
        ([*GOAL, '{pose: {header: {stamp: {sec: 1e12}}}}'], 1, "sec: '1e12', expected int32"),
        ([*GOAL, '{pose: {header: {stamp: {sec: true}}}}'], 1, "sec: 'True', expected int32"),
        (['topic', 'echo', '/a b', *AT_ONCE], 1, "'/a b' is no name of a topic"),
        (['topic', 'echo', '/x', 'std_msgs/msg/Nix'], 1, 'message type is invalid'),
        (['action', 'send_goal', '/x', 'x/action/X', '{}'], 1, 'action type is invalid'),
        (['service', 'call', '/a b', 'std_srvs/srv/Trigger'], 1, "'/a b' is no name of a service"),
        (['param', 'get', '/nobody', 'x', *AT_ONCE], 1, "Node not found: '/nobody'"),
        (['lifecycle', 'set', 'nobody', 'activate', *AT_ONCE], 1, "Node not found: '/nobody'"),
        (['topic', 'list', '--spin-time', 'long'], 2, 'long'),
    ],
)
def test_errors_are_reported_in_one_line(ros_domain, words, code, said):
    done = run(*words)
    assert done.returncode == code
    assert said in done.stderr and len(done.stderr.splitlines()) == 1
    assert not done.stdout


def test_a_topic_that_is_never_published_is_reported(ros_domain):
    done = run('topic', 'echo', '/nowhere', *AT_ONCE)
    assert done.returncode == 1
    assert done.stdout == 'WARNING: topic [/nowhere] does not appear to be published yet\n'
    assert done.stderr == 'Could not determine the type for the passed topic\n'


def test_the_real_one_wins_where_there_is_one(tmp_path):
    real = tmp_path / 'ros2'
    real.write_text('#!/bin/sh\necho the real one\n')
    real.chmod(0o755)
    kept = [p for p in os.environ['PATH'].split(':') if not Path(p).samefile(ROS2.parent)]
    environment = {**os.environ, 'PATH': ':'.join([str(tmp_path), *kept])}
    command = f'source {ROOT}/scripts/env && ros2 topic list'
    done = subprocess.run(
        ['bash', '-c', command], env=environment, capture_output=True, text=True, timeout=170.0
    )
    assert done.stdout == 'the real one\n', done.stderr
