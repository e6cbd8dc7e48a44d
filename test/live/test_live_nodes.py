"""Each node as a process on a live graph: its topics, start and end."""

import math
import signal

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid, Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from thinmap_msgs.msg import LocalGrid, SlamStatus, TopologicalMap
from thinmap_msgs.srv import SaveMap
from thinmap_ros.files import occupancy_maps
from thinmap_ros.logs.readers.bag import Bag
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
START = '2.0,2.0,0.0'
AT_START = {'initial_x_m': 2.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.0}
SCAN_PERIOD_NS = 200_000_000


def stamps(heard):
    return [messages.stamp_ns(message.header.stamp) for message in heard]


def test_the_simulated_robot_follows_commands_and_stops_without_them(graph):
    scans = graph.heard('scan', LaserScan, qos.SENSOR)
    odometry = graph.heard('odom', Odometry)
    clock = graph.heard('/clock', Clock)
    frames = graph.heard('/tf', TFMessage)
    graph.start('sim', start=START, real_time_factor=4.0)
    graph.until(
        lambda: len(scans) > 3 and odometry and clock and frames, 'scans, odometry, time and frames'
    )
    assert len(scans[0].ranges) == 181
    assert scans[0].header.frame_id == 'laser'
    assert scans[0].range_max == pytest.approx(8.0)
    commands = graph.node.create_publisher(Twist, 'cmd_vel', 10)
    forward = Twist()
    forward.linear.x = 0.2

    def driven():
        commands.publish(forward)
        return odometry[-1].pose.pose.position.x - odometry[0].pose.pose.position.x > 0.3

    graph.until(driven, 'the robot moves')
    graph.until(
        lambda: odometry[-1].twist.twist.linear.x == 0.0,
        'the robot stops when nothing is commanded',
    )
    assert {(t.header.frame_id, t.child_frame_id) for m in frames for t in m.transforms} == {
        ('odom', 'base_link')
    }
    assert graph.stop('sim') == 0


def test_each_of_two_lasers_has_its_topic_frame_and_pose(graph):
    scans = {name: graph.heard(f'{name}/scan', LaserScan, qos.SENSOR) for name in ('front', 'rear')}
    static = graph.heard('/tf_static', TFMessage, qos.STATIC_TRANSFORMS)
    graph.start('sim', robot='mir100', start=START, real_time_factor=4.0, wait_for_subscribers=1)
    graph.until(
        lambda: static and all(len(heard) > 3 for heard in scans.values()), 'scans of both lasers'
    )
    assert graph.node.count_publishers('scan') == 0
    for name, heard in scans.items():
        assert {scan.header.frame_id for scan in heard} == {f'{name}_laser'}
        assert len(heard[0].ranges) == 541
        assert heard[0].scan_time == pytest.approx(0.1)
    assert not set(stamps(scans['front'])) & set(stamps(scans['rear']))
    mounts = {'front_laser': (0.4288, 0.2358, 0.7854), 'rear_laser': (-0.3548, -0.2352, -2.3562)}
    for each in static[0].transforms:
        x, y, yaw = mounts.pop(each.child_frame_id)
        assert each.header.frame_id == 'base_link'
        assert (each.transform.translation.x, each.transform.translation.y) == (x, y)
        assert math.sin(yaw / 2.0) == pytest.approx(each.transform.rotation.z)
    assert not mounts


def test_a_scan_becomes_a_pose_a_map_and_a_graph(graph, tmp_path):
    poses = graph.heard('pose', PoseWithCovarianceStamped)
    status = graph.heard('slam_status', SlamStatus)
    scans = graph.heard('scan', LaserScan, qos.SENSOR)
    frames = graph.heard('/tf', TFMessage)
    local_maps = graph.heard('local_grid', LocalGrid, qos.LATCHED)

    def links():
        return {(t.header.frame_id, t.child_frame_id) for m in frames for t in m.transforms}

    graph.start('localizer', use_sim_time=True, **AT_START)
    graph.start('grid_mapper', use_sim_time=True)
    graph.start('topology_builder', use_sim_time=True)
    graph.start(
        'sim', start=START, real_time_factor=4.0, lockstep='local_topology', wait_for_subscribers=2
    )
    graph.until(
        lambda: len(local_maps) > 8 and poses and status and scans and ('map', 'odom') in links(),
        'local maps, poses, status, scans and the frame of the odometry',
    )
    # Not compared with the scans received here: best-effort messages may be lost for one subscriber
    # and not for another.
    assert not np.mod(np.array(stamps(poses)) - stamps(scans)[0], SCAN_PERIOD_NS).any()
    assert poses[-1].header.frame_id == 'map'
    assert (
        np.hypot(poses[-1].pose.pose.position.x - 2.0, poses[-1].pose.pose.position.y - 2.0) < 0.05
    )
    assert status[-1].state == SlamStatus.TRACKING
    # Late subscribers still receive map and graph: both are transient local.
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    graphs = graph.heard('topology', TopologicalMap, qos.LATCHED)
    graph.until(lambda: maps and graphs and graphs[-1].node_ids, 'map and topology')
    assert maps[-1].info.resolution == pytest.approx(0.05)
    response = graph.call(SaveMap, 'save_map', SaveMap.Request(path=str(tmp_path / 'room')))
    assert response.success, response.message
    assert occupancy_maps.read_map(tmp_path / 'room.yaml').cells.shape[0] > 20
    response = graph.call(SaveMap, 'save_map', SaveMap.Request(path='/proc/nowhere/room'))
    assert not response.success
    assert '/proc/nowhere' in response.message
    for name in list(graph.processes):
        assert graph.stop(name, signal.SIGTERM) == 0


def test_bad_messages_are_refused_in_words_and_nothing_dies(graph):
    poses = graph.heard('pose', PoseWithCovarianceStamped)
    graph.start('localizer', laser_pose='0.1,0.0,0.0')
    scan_topic = graph.node.create_publisher(LaserScan, 'scan', qos.STREAM)
    odom_topic = graph.node.create_publisher(Odometry, 'odom', qos.STREAM)
    graph.until(
        lambda: scan_topic.get_subscription_count() and odom_topic.get_subscription_count(),
        'localizer',
    )

    def say(seconds, x, count=181, increment=np.pi / 180.0):
        odometry = Odometry()
        odometry.header.stamp = messages.time_msg(int(seconds * 1e9))
        odometry.header.frame_id = 'odom'
        odometry.child_frame_id = 'base_link'
        odometry.pose.pose.position.x = x
        odometry.pose.pose.orientation.w = 1.0
        odom_topic.publish(odometry)
        scan = LaserScan(angle_min=-1.57, angle_increment=increment, range_min=0.05, range_max=8.0)
        scan.header.stamp = odometry.header.stamp
        scan.header.frame_id = 'laser'
        scan.ranges = [2.0] * count
        scan_topic.publish(scan)

    said = [0.0]

    def good_again():
        said[0] += 0.2
        say(said[0], 0.0)
        return len(poses) > 2

    graph.until(good_again, 'poses')

    def bad_again():
        for bad in (
            {'x': float('nan')},
            {'x': 0.0, 'increment': 0.0},
            {'x': 0.0, 'count': 0},
            {'x': 1e300},
        ):
            said[0] += 0.2
            say(said[0], **bad)
        return all(topic in graph.log('localizer') for topic in ('odom: ', 'scan: '))

    graph.until(bad_again, 'what is wrong, in words')
    bad_ns = int(said[0] * 1e9)
    graph.until(lambda: good_again() and stamps(poses)[-1] > bad_ns, 'poses after bad messages')
    assert all(np.isfinite([p.pose.pose.position.x, *p.pose.covariance]).all() for p in poses)
    assert graph.stop('localizer') == 0, graph.log('localizer')


@pytest.mark.parametrize(
    ('name', 'parameters', 'said'),
    [
        ('localizer', {'gaet': 1.0, 'strict_parameters': True}, 'no parameter gaet'),
        ('grid_mapper', {'resolution_m': 0.0}, 'resolution_m'),
        ('sim', {'world': 'atlantis'}, 'atlantis'),
        ('sim', {'start': '1,2'}, 'x,y,theta'),
        ('sim', {'robot': '4wd'}, '4wd'),
        ('bag_player', {'bag': '/nowhere/bag'}, '/nowhere/bag'),
        ('localizer', {'laser_pose': '1,2,nan'}, 'laser_pose'),
    ],
)
def test_a_wrong_parameter_ends_the_start_with_one_clear_line(graph, name, parameters, said):
    process = graph.start(name, **parameters)
    assert graph.ended(process) == 2
    lines = graph.log(name).strip().splitlines()
    assert said in lines[-1]
    assert 'Traceback' not in graph.log(name)


def is_free(map_message, x, y):
    patch = messages.grid_from_msg(map_message)
    point = np.array([[x, y]])
    row, col = patch.frame.cells_of(point)[0]
    return bool(patch.contains(point)[0]) and bool(patch.free[row, col])


def test_the_navigator_drives_to_a_goal_and_refuses_one_in_a_wall(graph):
    truth = graph.heard('ground_truth', PoseStamped)
    for name in ('localizer', 'grid_mapper', 'topology_builder', 'navigator'):
        graph.start(name, use_sim_time=True, **(AT_START if name == 'localizer' else {}))
    # Paced: otherwise the result could arrive before the true poses of the path.
    graph.start(
        'sim',
        remap=graph.paced(),
        start=START,
        real_time_factor=8.0,
        lockstep='local_topology',
        wait_for_subscribers=2,
    )
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    graph.until(lambda: maps and is_free(maps[-1], 3.0, 2.0), 'a map that knows the goal')
    goal = NavigateToPose.Goal()
    goal.pose.header.frame_id = 'map'
    goal.pose.pose.position.x = 3.0
    goal.pose.pose.position.y = 2.0
    goal.pose.pose.orientation.w = 1.0
    ended = graph.act(NavigateToPose, 'navigate_to_pose', goal)
    assert ended.status == GoalStatus.STATUS_SUCCEEDED, ended.result
    graph.until(lambda: truth, 'true pose')
    position = truth[-1].pose.position
    assert np.hypot(position.x - 3.0, position.y - 2.0) < 0.3
    goal.pose.pose.position.x = 60.0
    ended = graph.act(NavigateToPose, 'navigate_to_pose', goal)
    assert ended.status == GoalStatus.STATUS_ABORTED
    assert ended.result


def test_what_is_recorded_is_played_again(graph, tmp_path):
    scans = graph.heard('scan', LaserScan)
    graph.start('recorder', bag=str(tmp_path / 'bag'))
    graph.start('sim', start=START, real_time_factor=8.0)
    recorded = ('/tf', '/tf_static', '/odom', '/clock')
    graph.until(
        lambda: all(graph.node.count_subscribers(topic) for topic in recorded),
        'a recorder that listens',
    )
    enough = len(scans) + 40
    graph.until(lambda: len(scans) > enough, 'scans')
    assert graph.stop('sim') == 0
    assert graph.stop('recorder') == 0
    bag = Bag(tmp_path / 'bag')
    kept = list(bag.messages({'/scan'}))
    assert {'/scan', *recorded} <= set(bag.topics)
    assert len(kept) > 20
    scans.clear()
    # The player waits for the test to receive each scan, as its queue is limited.
    heard_it = graph.node.create_publisher(TopologicalMap, 'local_topology', qos.STREAM)
    graph.node.create_subscription(
        LaserScan, 'scan', lambda scan: heard_it.publish(TopologicalMap(header=scan.header)), 10
    )
    player = graph.start(
        'bag_player',
        bag=str(tmp_path / 'bag'),
        rate=20.0,
        lockstep='local_topology',
        wait_for_subscribers=2,
    )
    graph.until(
        lambda: player.poll() == 0 and len(scans) == len(kept), 'as many scans as were recorded'
    )
    assert stamps(scans) == [messages.stamp_ns(bag.decode(raw).header.stamp) for raw in kept]
    # A bag is never overwritten.
    again = graph.start('recorder', bag=str(tmp_path / 'bag'))
    assert graph.ended(again) == 2
    assert 'exists already' in graph.log('recorder')
