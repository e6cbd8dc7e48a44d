"""Commands as they are published, and the stop that follows the last one by itself."""

import pytest
import rclpy
from geometry_msgs.msg import Twist, TwistStamped
from support.live_graph import graph as graph

from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.velocity.commands import TOPIC, VelocityPublisher

pytestmark = pytest.mark.live


@pytest.fixture
def driver(ros_domain):
    """A node that is never spun: it is busy."""
    rclpy.init(domain_id=ros_domain)
    node = ThinmapNode('driver')
    yield node
    node.destroy_node()
    rclpy.try_shutdown()


def test_a_motion_ends_though_its_node_is_busy_and_nobody_commands_a_stop(driver, graph):
    commands = graph.heard(TOPIC, Twist)
    velocity = VelocityPublisher(driver, 'base_link', is_stamped=False)
    graph.until(lambda: driver.count_subscribers(TOPIC) > 0, 'the subscriber is discovered')
    graph.until(lambda: velocity.publish(0.4, -0.2) or commands, 'a command')
    assert (commands[0].linear.x, commands[0].angular.z) == (0.4, -0.2)
    assert not velocity.is_interrupted
    graph.until(lambda: commands[-1] == Twist(), 'a stop')
    graph.until(lambda: velocity.is_interrupted, 'a note')
    velocity.publish(0.1, 0.0)
    assert not velocity.is_interrupted
    velocity.stop()
    graph.until(lambda: commands[-1] == Twist(), 'a stop at the end')


def test_stamped_commands_have_the_frame_of_the_robot(driver, graph):
    commands = graph.heard(TOPIC, TwistStamped)
    velocity = VelocityPublisher(driver, 'base_footprint', is_stamped=True)
    graph.until(lambda: velocity.publish(0.3, 0.0) or commands, 'a command')
    velocity.stop()
    assert commands[0].header.frame_id == 'base_footprint'
    assert commands[0].header.stamp.sec > 0
    assert commands[0].twist.linear.x == 0.3
