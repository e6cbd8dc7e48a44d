"""Several simulated robots in one world: a namespace for each, one clock."""

import math

import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan
from std_msgs.msg import UInt32
from tf2_msgs.msg import TFMessage

from thinmap_ros.core import se2
from thinmap_ros.ros import messages, qos
from thinmap_ros.sim.robot import PRESETS

pytestmark = pytest.mark.live
RADIUS_M = PRESETS['2dx'].radius_m
NAMES = ('robot1', 'robot2')
# Face to face, 2 m apart.
STARTS = f'2.0,3.0,0.0; 4.0,3.0,{math.pi}'


def stamp(message):
    return messages.stamp_ns(message.header.stamp)


def ahead_m(scan):
    """Range of the middle beam."""
    return scan.ranges[len(scan.ranges) // 2]


def test_two_robots_have_topics_of_their_own_and_see_and_touch_each_other(graph):
    scans = {name: graph.heard(f'{name}/scan', LaserScan, qos.SENSOR) for name in NAMES}
    odometry = {name: graph.heard(f'{name}/odom', Odometry) for name in NAMES}
    truth = {name: graph.heard(f'{name}/ground_truth', PoseStamped) for name in NAMES}
    contacts = {name: graph.heard(f'{name}/collisions', UInt32, qos.LATCHED) for name in NAMES}
    frames = {name: graph.heard(f'{name}/tf', TFMessage) for name in NAMES}
    clock = graph.heard('/clock', Clock)
    graph.start('sim', robots=2, starts=STARTS, real_time_factor=10.0)
    heard = [topic[name] for topic in (scans, odometry, truth, contacts, frames) for name in NAMES]
    graph.until(lambda: clock and all(heard), 'all topics of both robots')
    assert graph.node.count_publishers('/clock') == 1
    assert graph.node.count_publishers('scan') == 0
    assert graph.node.count_publishers('/tf') == 0
    for name in NAMES:
        assert ahead_m(scans[name][0]) == pytest.approx(2.0 - RADIUS_M, abs=0.1)
        links = {(t.header.frame_id, t.child_frame_id) for m in frames[name] for t in m.transforms}
        assert links == {('odom', 'base_link')}
        assert stamp(scans[name][0]) % 200_000_000 == 0
        assert contacts[name][-1].data == 0

    commands = graph.node.create_publisher(Twist, 'robot1/cmd_vel', 10)
    forward = Twist()
    forward.linear.x = 0.5

    def has_touched():
        commands.publish(forward)
        return contacts['robot1'][-1].data > 0

    graph.until(has_touched, 'a contact')

    def at(name):
        return messages.pose_from_msg(truth[name][-1].pose)

    # The number of contacts may come before the place of this one.
    graph.until(lambda: abs(at('robot1')[0] - (4.0 - 2.0 * RADIUS_M)) < 0.05, 'the place of it')
    assert at('robot2').tolist() == pytest.approx([4.0, 3.0, math.pi])
    assert contacts['robot2'][-1].data == 0

    away = PoseStamped(pose=messages.pose_msg(se2.pose(4.0, 8.0, 0.0)))
    teleports = graph.node.create_publisher(PoseStamped, 'sim/robot2/set_pose', 10)

    def is_out_of_sight():
        teleports.publish(away)
        return ahead_m(scans['robot1'][-1]) > 3.0

    graph.until(is_out_of_sight, 'robot2 elsewhere')
    assert graph.stop('sim') == 0


def test_time_waits_for_the_results_of_both_robots(graph):
    scans = {name: graph.heard(f'{name}/scan', LaserScan, qos.SENSOR) for name in NAMES}
    results = {
        name: graph.node.create_publisher(PoseWithCovarianceStamped, f'{name}/pose', qos.STREAM)
        for name in NAMES
    }
    graph.start(
        'sim',
        robots=2,
        starts=STARTS,
        real_time_factor=10.0,
        lockstep='pose',
        lockstep_timeout_s=3600.0,
        wait_for_subscribers=1,
    )

    def answer(name):
        result = PoseWithCovarianceStamped(header=scans[name][-1].header)
        results[name].publish(result)

    def count(name):
        return len(scans[name])

    subscribed = [publisher.get_subscription_count for publisher in results.values()]
    graph.until(lambda: all(each() for each in subscribed), 'sim')
    # The first scan comes again until there is a result.
    graph.until(lambda: count('robot1') > 1 and count('robot2') > 1, 'scans')

    def only_robot2_waits():
        answer('robot1')
        counts.append((count('robot1'), count('robot2')))
        # Since the first answer has arrived, which a busy machine may take a while for.
        since = next(second for first, second in counts if first == counts[-1][0])
        return counts[-1][1] > since + 3

    counts = []
    graph.until(only_robot2_waits, 'the first scan of robot2 alone again and again')
    assert {stamp(scan) for name in NAMES for scan in scans[name]} == {0}

    def later():
        for name in NAMES:
            answer(name)
        return all(stamp(scans[name][-1]) > 400_000_000 for name in NAMES)

    graph.until(later, 'scans of later times')
    assert graph.stop('sim') == 0


@pytest.mark.parametrize(
    ('values', 'said'),
    [
        ({'robots': 0}, 'robots'),
        ({'robots': 10}, 'robots'),
        ({'robots': 2, 'starts': '2,2,0'}, 'expected as many as robots (2), found 1'),
        ({'robots': 2, 'starts': '2,2,0; 2.1,2,0'}, 'start [2.1, 2.0]'),
        ({'robots': 2, 'starts': '2,2,0; 3,nan,0'}, "starts = ' 3,nan,0': expected"),
        ({'robots': 2, 'starts': '2,2,0; 99,2,0'}, 'start [99.0, 2.0]'),
        ({'starts': '2,2,0', 'start': '2,2,0'}, 'expected one of the two'),
        ({'robots': 9, 'world': 'dead_end', 'start': '0.6,0.6,0.0'}, 'expected room for 9 robots'),
    ],
)
def test_odd_robots_and_starts_end_the_start_with_one_clear_line(graph, values, said):
    process = graph.start('sim', **values)
    assert graph.ended(process) == 2
    log = graph.log('sim')
    assert said in log.strip().splitlines()[-1]
    assert 'Traceback' not in log
