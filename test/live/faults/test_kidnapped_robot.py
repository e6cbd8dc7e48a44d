"""A robot in a saved map on a live graph.

It is localized after a start anywhere and after kidnapping, and continues mapping.
"""

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from nav_msgs.msg import OccupancyGrid

from thinmap_msgs.msg import SlamStatus
from thinmap_msgs.srv import SaveMap
from thinmap_ros.core import se2
from thinmap_ros.ros import messages, qos

pytestmark = [pytest.mark.live, pytest.mark.slow, pytest.mark.timeout(400)]
START = (2.0, 2.0, 0.0)
ELSEWHERE = (5.5, 2.0, 1.0)
THERE = (3.8, 7.6, -1.2)
LOST = {SlamStatus.LOST, SlamStatus.MAPPING_APART}
NODES = ('grid_mapper', 'topology_builder', 'localizer')


class Robot:
    """A robot that drives in circles, and its published poses and status."""

    def __init__(self, graph):
        self.graph = graph
        self.truth = graph.heard('ground_truth', PoseStamped)
        self.poses = graph.heard('pose', PoseWithCovarianceStamped)
        self.status = graph.heard('slam_status', SlamStatus)
        self.maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
        self.commands = graph.node.create_publisher(Twist, 'cmd_vel', 10)

    def drive_until(self, condition, what):
        ahead = Twist()
        ahead.linear.x = 0.25
        ahead.angular.z = 0.3

        def met():
            self.commands.publish(ahead)
            return self.poses and self.truth and condition()

        self.graph.until(met, what, 150.0)

    def seconds(self):
        return messages.stamp_ns(self.truth[-1].header.stamp) / 1e9

    def states(self, since_s=0.0):
        return [s.state for s in self.status if messages.stamp_ns(s.header.stamp) >= since_s * 1e9]

    def off(self):
        """Error of the newest pose at its stamp: m, rad."""
        ns = messages.stamp_ns(self.poses[-1].header.stamp)
        at = min(self.truth, key=lambda message: abs(messages.stamp_ns(message.header.stamp) - ns))
        off = se2.between(
            messages.pose_from_msg(at.pose), messages.pose_from_msg(self.poses[-1].pose.pose)
        )
        return np.hypot(off[0], off[1]), abs(off[2])

    def is_right(self, since_s=0.0):
        tracking = self.states(since_s)[-5:] == [SlamStatus.TRACKING] * 5
        return tracking and self.off()[0] < 0.3 and self.off()[1] < np.radians(10.0)


def start_sim(graph, at, subscribers):
    text = ','.join(map(str, at))
    graph.start(
        'sim',
        start=text,
        real_time_factor=6.0,
        lockstep='local_topology',
        wait_for_subscribers=subscribers,
    )


def test_a_robot_is_localized_in_a_saved_map_and_after_kidnapping(graph, tmp_path):
    robot = Robot(graph)
    stem = tmp_path / 'room'
    x, y, yaw = START
    for name in NODES:
        start = (
            {'initial_x_m': x, 'initial_y_m': y, 'initial_yaw_rad': yaw}
            if name == 'localizer'
            else {}
        )
        graph.start(name, use_sim_time=True, **start)
    start_sim(graph, START, 1)
    robot.drive_until(lambda: robot.seconds() > 30.0, 'a map of the room')
    saved = graph.call(SaveMap, 'save_map', SaveMap.Request(path=str(stem)))
    assert saved.success and '.slam.npz' in saved.message, saved.message
    assert [graph.stop(name) for name in ('sim', *NODES)] == [0] * 4
    graph.drain()
    heard = robot.truth, robot.poses, robot.status, robot.maps
    for messages_of_then in heard:
        messages_of_then.clear()

    for name in NODES:
        graph.start(name, use_sim_time=True, session_path=str(stem))
    graph.start('global_localizer', use_sim_time=True, start_automatically=True)
    start_sim(graph, ELSEWHERE, 2)
    robot.drive_until(robot.is_right, 'the place where it was switched on')
    assert robot.states()[0] == SlamStatus.LOST
    found_s = robot.seconds()
    robot.drive_until(lambda: robot.seconds() > found_s + 8.0, 'some more of the map')
    assert robot.is_right(found_s)

    lost_s = robot.seconds()
    commands = graph.node.create_publisher(PoseStamped, 'sim/set_pose', 10)
    graph.until(lambda: commands.get_subscription_count(), 'somebody who carries')
    commands.publish(messages.pose_stamped_msg(np.array(THERE), 'world', 0))
    robot.drive_until(lambda: LOST & set(robot.states(lost_s)), 'that it is lost')
    assert robot.seconds() - lost_s < 5.0 + 1.0
    lost_s = robot.seconds()
    robot.drive_until(lambda: robot.is_right(lost_s), 'the place to which it was carried')
