"""`thinmap robot`: one command checks a robot, maps, explores, and saves the session at its end."""

import signal

import pytest
from nav_msgs.msg import Odometry
from support.forks import forked
from support.timeouts import PATIENCE_S

from thinmap_msgs.msg import ExplorationStatus, SlamStatus
from thinmap_ros.files import sessions
from thinmap_ros.ros import qos

pytestmark = pytest.mark.live
ENDS = ('.exploration.npz', '.grid.npz', '.keyframes.npz', '.slam.npz', '.topology.npz', '.yaml')


PACED = {'lockstep': 'local_topology', 'wait_for_subscribers': 3}


def start_robot(graph, *arguments, **values):
    graph.start('robot', package='thinmap_ros.tools', arguments=arguments, **values)


@pytest.mark.cpu_budget(20.0, 'six nodes, started twice')
def test_one_command_explores_and_saves_and_the_next_one_continues(graph):
    explorations = graph.heard('exploration_status', ExplorationStatus, qos.LATCHED)
    words = ('--preset', 'pioneer', '--explore', '--save', 'maps/room', '--seconds', '0')
    start_robot(graph, *words, use_sim_time=True)
    graph.start('sim', remap=graph.paced(), start='2.0,2.0,0.0', real_time_factor=4.0, **PACED)
    graph.until(lambda: explorations and explorations[-1].distance_m > 0.5, 'a drive')
    assert graph.stop('robot', signal.SIGINT) == 0, graph.log('robot')
    stem = graph.folder / 'maps' / 'room'
    assert all(stem.with_name(f'room{end}').is_file() for end in ENDS), graph.log('robot')
    assert sessions.load_grid(str(stem)).known_area().free.sum() > 5000
    # The next one looks at the robot, whose clock it follows, and continues.
    graph.stop('sim')
    graph.start('sim', start='2.0,2.0,0.0')
    odometry = graph.heard('odom', Odometry)
    graph.until(lambda: odometry, 'the robot')
    states = graph.heard('slam_status', SlamStatus)
    start_robot(graph, '--map', 'maps/room', '--start', '2,2,0', '--save', 'maps/next')
    graph.until(lambda: states and states[-1].state == SlamStatus.TRACKING, 'its place')
    assert states[-1].header.stamp.sec < 1e6  # of the simulation
    assert graph.stop('robot', signal.SIGTERM) == 0, graph.log('robot')
    assert (graph.folder / 'maps' / 'next.yaml').is_file()


def test_what_the_robot_lacks_is_said_and_nothing_starts(ros_domain, tmp_path):
    done = forked.run(
        'thinmap_ros.tools.robot', '--seconds', '0.5', folder=tmp_path, timeout=PATIENCE_S
    )
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]
    assert '✗ topic /scan' in done.stderr and '✗ topic /odom' in done.stderr
    assert 'checks of the robot are wrong: expected none, or --seconds 0' in last
    assert not list(tmp_path.iterdir())


def test_topics_and_frames_are_those_of_the_parameters(ros_domain, tmp_path):
    words = ['--ros-args', '-p', 'scan_topic:=front/scan', '-p', 'odom_source:=tf']
    words += ['-p', 'laser_pose:="0.1,0.0,0.0"', '-r', 'cmd_vel:=base/cmd']
    done = forked.run(
        'thinmap_ros.tools.robot', '--seconds', '0.5', *words, folder=tmp_path, timeout=PATIENCE_S
    )
    assert 'topic /front/scan' in done.stderr
    assert '/odom' not in done.stderr
    assert 'transform odom -> base_link' in done.stderr


@pytest.mark.parametrize(
    ('words', 'expected'),
    [
        (['--preset', 'turtlebot5'], "invalid choice: 'turtlebot5'"),
        (['--start', '1,2,0'], '--start: a pose in a map: expected --map'),
        (['--map', 'maps/x', '--start', '1'], '1'),
    ],
)
def test_wrong_usage_is_one_line(ros_domain, tmp_path, words, expected):
    done = forked.run('thinmap_ros.tools.robot', *words, folder=tmp_path, timeout=PATIENCE_S)
    assert done.returncode == 2
    assert done.stderr.count('\n') == 1
    assert expected in done.stderr
