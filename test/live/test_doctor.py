"""`thinmap doctor` on a robot that has all, on one under other names, and on none."""

import threading
import time

import pytest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import LaserScan
from support.forks import forked
from support.timeouts import PATIENCE_S

from thinmap_ros.core.se2 import pose
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
TICK_S = 0.05


def lines(*arguments, heard=()):
    """Exit code and lines; asks again, as a person would, until it has heard what there is.

    heard: texts that say so. A busy machine may take longer to discover it than it listens.
    """
    end_s = time.monotonic() + PATIENCE_S
    while True:
        done = forked.run('thinmap_ros.tools.doctor', *arguments)
        assert done.stderr == ''
        if all(text in done.stdout for text in heard) or time.monotonic() > end_s:
            return done.returncode, done.stdout.splitlines()


def test_a_robot_that_has_all_is_told_so(graph):
    scans = graph.heard('scan', LaserScan, qos.SENSOR)
    graph.start('sim', start='2.0,2.0,0.0')
    graph.until(lambda: scans, 'a scan')
    code, said = lines('--seconds', '3', heard=['all is there'])
    assert (code, said[-1]) == (0, 'all is there'), said
    table = '\n'.join(said)
    assert all(line.startswith('✓') for line in said[:-1])
    assert '/scan' in table and '181 beams over 180 degrees' in table
    assert '/clock is published: use_sim_time:=true' in table
    assert 'geometry_msgs/msg/Twist to /sim; nobody publishes it yet' in table


def test_each_of_several_lasers_has_its_rows(graph):
    publishers = {name: graph.node.create_publisher(LaserScan, name, qos.SENSOR) for name in 'ab'}
    frames = dict.fromkeys(publishers, 'laser')
    beats = [0]

    def publish():
        beats[0] += 1
        for name, publisher in publishers.items():
            scan = LaserScan(angle_increment=0.01, range_max=8.0, ranges=[2.0] * 100)
            scan.header.frame_id = frames[name]
            scan.header.stamp = messages.time_msg(beats[0] * 10**8)
            publisher.publish(scan)

    timer = graph.node.create_timer(0.1, publish)
    thread = threading.Thread(target=graph.executor.spin)
    thread.start()
    try:
        both = ['✓ topic /a', '✓ topic /b', 'of its type: /a, /b']
        code, said = lines('--seconds', '3', '--scan-topic', 'a', 'b', 'c', heard=both)
        table = '\n'.join(said)
        assert code == 1
        for name in 'ab':
            assert f'✓ topic /{name}' in table, table
        assert table.count('100 beams over') == 2
        assert '✗ topic /c' in table and 'no publisher; of its type: /a, /b' in table
        assert '✗ frames of the lasers' in table and "2 lasers in 'laser'" in table
        frames['b'] = 'other'
        apart = [f'✗ transform base_link -> {frame}' for frame in ('laser', 'other')]
        _, said = lines('--seconds', '3', '--scan-topic', 'a', 'b', heard=apart)
        table = '\n'.join(said)
        assert 'frames of the lasers' not in table
        assert all(line in table for line in apart)
        assert 'set laser_pose' not in table
    finally:
        timer.cancel()
        graph.executor.shutdown()
        thread.join()


def test_what_a_robot_lacks_is_named_with_what_to_do(graph):
    """Scans under another name, odometry of another type, and no frames."""
    scans = graph.node.create_publisher(LaserScan, 'front/scan', qos.SENSOR)
    wrong = graph.node.create_publisher(LaserScan, 'odom', qos.SENSOR)
    commands = graph.node.create_publisher(Twist, 'cmd_vel', 1)
    assert scans and wrong and commands
    all_three = ['of its type: /front/scan, /odom', 'expected nav_msgs', '/test_client']
    code, said = lines('--seconds', '2', heard=all_three)
    table = '\n'.join(said)
    assert code == 1
    assert '✗ topic /scan' in table and 'no publisher; of its type: /front/scan, /odom' in table
    assert 'type sensor_msgs/msg/LaserScan' in table and 'expected nav_msgs/msg/Odometry' in table
    assert '✗ transform odom -> base_link' in table and 'none; frames: none' in table
    assert '✗ topic /cmd_vel' in table and 'driven; published by /test_client' in table
    assert said[-1] == '4 of 6 are wrong'


def test_a_driver_that_publishes_nothing_is_named(graph):
    publisher = graph.node.create_publisher(Odometry, 'wheels', qos.SENSOR)
    assert publisher
    silent = 'a publisher, and no message'
    _, said = lines('--seconds', '2', '--odom-topic', 'wheels', heard=[silent])
    assert silent in '\n'.join(said)


class Base:
    """A base that turns as told, with or without a time-out of its commands, in its own time."""

    def __init__(self, graph, timeout_s):
        self._timeout_s = timeout_s
        self._w = self._told_s = self._yaw = self._now_s = 0.0
        node = Node('base', context=graph.context)
        node.create_subscription(Twist, 'cmd_vel', self._on_command, 10)
        self._odometry = node.create_publisher(Odometry, 'odom', 10)
        node.create_timer(TICK_S, self._step)
        self._executor = SingleThreadedExecutor(context=graph.context)
        self._executor.add_node(node)
        self._node = node
        self._thread = threading.Thread(target=self._executor.spin)
        self._thread.start()

    def close(self):
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()

    def _on_command(self, message):
        self._w = message.angular.z
        self._told_s = self._now_s

    def _step(self):
        self._now_s += TICK_S
        if self._now_s - self._told_s > self._timeout_s:
            self._w = 0.0
        self._yaw += TICK_S * self._w
        here = pose(0.0, 0.0, self._yaw)
        frames = ('odom', 'base_link')
        stamp_ns = round(1e9 * self._now_s)
        self._odometry.publish(messages.odometry_msg(here, (0.0, self._w), frames, stamp_ns))


@pytest.mark.parametrize(
    ('timeout_s', 'words'),
    [
        (1.0, '✓ watchdog of the base  stands within 2 s after the last command'),
        (1e9, '✗ watchdog of the base  turns on at 0.'),
    ],
)
def test_the_time_out_of_a_base_is_tried_and_the_base_stands_in_the_end(graph, timeout_s, words):
    base = Base(graph, timeout_s)
    try:
        commands = graph.heard('cmd_vel', Twist)
        code, said = lines('--try-watchdog', '--yes', heard=[words])
        assert said[0].startswith(words)
        assert code == (0 if words.startswith('✓') else 1)
        graph.until(lambda: commands and commands[-1].angular.z == 0.0, 'a stop')
        assert 0.0 < max(command.angular.z for command in commands) <= 0.3
    finally:
        base.close()


def test_a_base_is_not_moved_without_consent_and_not_beside_another_driver(graph):
    commands = graph.heard('cmd_vel', Twist)
    done = forked.run('thinmap_ros.tools.doctor', '--try-watchdog')
    assert done.returncode == 2 and 'expected --yes, or a terminal' in done.stderr
    driver = graph.node.create_publisher(Twist, 'cmd_vel', 10)
    base = Base(graph, 1.0)
    try:
        done = forked.run('thinmap_ros.tools.doctor', '--try-watchdog', '--yes')
    finally:
        base.close()
    assert driver and done.returncode == 2
    assert 'published by /test_client: end it first' in done.stderr
    assert not commands
