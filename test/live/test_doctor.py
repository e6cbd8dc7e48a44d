"""`thinmap doctor` on a robot that has all, on one under other names, and on none."""

import pytest
from nav_msgs.msg import Odometry
from sensor_msgs.msg import LaserScan
from support.forks import forked

from thinmap_ros.ros import qos

pytestmark = pytest.mark.live


def lines(*arguments):
    done = forked.run('thinmap_ros.tools.doctor', *arguments)
    assert done.stderr == ''
    return done.returncode, done.stdout.splitlines()


def test_a_robot_that_has_all_is_told_so(graph):
    scans = graph.heard('scan', LaserScan, qos.SENSOR)
    graph.start('sim', start='2.0,2.0,0.0')
    graph.until(lambda: scans, 'a scan')
    code, said = lines('--seconds', '3')
    assert (code, said[-1]) == (0, 'all is there'), said
    table = '\n'.join(said)
    assert all(line.startswith('✓') for line in said[:-1])
    assert '/scan' in table and '181 beams over 180 degrees' in table
    assert '/clock is published: use_sim_time:=true' in table


def test_what_a_robot_lacks_is_named_with_what_to_do(graph):
    """Scans under another name, odometry of another type, and no frames."""
    scans = graph.node.create_publisher(LaserScan, 'front/scan', qos.SENSOR)
    wrong = graph.node.create_publisher(LaserScan, 'odom', qos.SENSOR)
    assert scans and wrong
    code, said = lines('--seconds', '2')
    table = '\n'.join(said)
    assert code == 1
    assert '✗ topic /scan' in table and 'no publisher; of its type: /front/scan, /odom' in table
    assert 'type sensor_msgs/msg/LaserScan' in table and 'expected nav_msgs/msg/Odometry' in table
    assert '✗ transform odom -> base_link' in table and 'none; frames: none' in table
    assert said[-1] == '3 of 5 are wrong'


def test_a_driver_that_publishes_nothing_is_named(graph):
    publisher = graph.node.create_publisher(Odometry, 'wheels', qos.SENSOR)
    assert publisher
    _, said = lines('--seconds', '2', '--odom-topic', 'wheels')
    assert 'a publisher, and no message' in '\n'.join(said)
