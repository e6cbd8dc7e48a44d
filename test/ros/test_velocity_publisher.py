"""Commands as they are published, and the stop that follows the last one by itself."""

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Bool
from support.live_graph import graph as graph

from thinmap_ros.ros import messages
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.velocity import TOPIC, VelocityPublisher

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


def spun(node):
    """A function that does what a node has to do now, and returns False."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    return lambda: executor.spin_once(timeout_sec=0.0)


def test_the_type_is_that_of_the_base_whenever_it_comes(driver, graph):
    spin = spun(driver)
    velocity = VelocityPublisher(driver, 'base_link', is_stamped=False)
    velocity.hold(True)
    commands = graph.heard(TOPIC, TwistStamped)
    graph.until(lambda: spin() or velocity.publish(0.3, 0.0) or commands, 'a stamped command')
    velocity.stop()


def test_while_it_is_held_each_motion_of_another_is_answered_and_named(driver, graph):
    spin = spun(driver)
    reports = graph.heard('/diagnostics', DiagnosticArray)
    velocity = VelocityPublisher(driver, 'base_link', is_stamped=False)
    commands = graph.heard(TOPIC, Twist)
    peer = graph.node.create_publisher(Twist, TOPIC, 10)
    graph.until(lambda: peer.get_subscription_count() == 1, 'the base')
    velocity.hold(True)
    graph.until(lambda: peer.get_subscription_count() == 2, 'its guard')
    for k in range(20):
        peer.publish(messages.twist_msg(0.0, 1.0))
        graph.until(lambda k=k: spin() or len(commands) == 2 * k + 2, 'an answer')
        assert commands[-1] == Twist()

    def is_named():
        spin()
        peer.publish(messages.twist_msg(0.0, 1.0))
        return reports and 'test_client drives the stopped' in reports[-1].status[0].message

    graph.until(is_named, 'who drives')
    velocity.hold(False)
    graph.until(lambda: spin() or peer.get_subscription_count() == 1, 'no guard')
    velocity.stop()


def test_a_page_beside_the_navigator_is_no_rival(driver, graph):
    spin = spun(driver)
    reports = graph.heard('/diagnostics', DiagnosticArray)
    velocity = VelocityPublisher(driver, 'base_link', is_stamped=False)
    graph.node.create_publisher(Twist, TOPIC, 10)

    def says(words):
        spin()
        return reports and words in reports[-1].status[0].message

    graph.until(lambda: says('2 nodes publish /cmd_vel'), 'a rival')
    graph.node.create_publisher(Bool, 'stop', 1)
    graph.until(lambda: says('running'), 'a node that can stop the robot is none')
    velocity.stop()
