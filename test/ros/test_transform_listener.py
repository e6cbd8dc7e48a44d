"""Lookup of transforms along the tree of frames, at a time and at the newest one."""

import math
import time

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.logs.transforms import TransformBuffer
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.executor import NodeExecutor
from thinmap_ros.ros.tf import TransformListener

SECOND_NS = 10**9


def transform(parent, child, T, seconds=0.0):
    return messages.transform_msg(np.array(T), parent, child, round(seconds * SECOND_NS))


@pytest.fixture
def robot():
    """map -> odom at 1 and 3 s, odom -> base_footprint at 1 and 2 s, a laser mounted on it."""
    buffer = TransformBuffer()
    buffer.add(transform('map', 'odom', (1.0, 0.0, 0.0), 1.0), is_static=False)
    buffer.add(transform('map', 'odom', (3.0, 0.0, 0.0), 3.0), is_static=False)
    buffer.add(transform('odom', 'base_footprint', (0.0, 0.0, 0.0), 1.0), is_static=False)
    buffer.add(transform('odom', 'base_footprint', (0.0, 2.0, math.pi / 2), 2.0), is_static=False)
    buffer.add(transform('base_footprint', 'laser', (0.5, 0.0, 0.0)), is_static=True)
    return buffer


def test_transforms_are_interpolated_at_the_time_that_is_asked_for(robot):
    T_map_base = robot.lookup('map', 'base_footprint', round(1.5 * SECOND_NS))
    np.testing.assert_allclose(T_map_base[:2], (1.5, 1.0), atol=0.3)
    np.testing.assert_allclose(T_map_base[2], math.pi / 4, atol=1e-9)


def test_the_newest_is_that_at_which_all_transforms_are_known(robot):
    expected = se2.compose(se2.pose(2.0, 2.0, math.pi / 2), se2.pose(0.5, 0.0, 0.0))
    np.testing.assert_allclose(robot.lookup('map', 'laser'), expected, atol=1e-9)


def test_a_lookup_in_the_other_direction_is_the_inverse(robot):
    there = robot.lookup('map', 'laser')
    np.testing.assert_allclose(robot.lookup('laser', 'map'), se2.invert(there), atol=1e-9)


def test_two_branches_are_connected_by_their_common_ancestor(robot):
    robot.add(transform('base_footprint', 'camera', (0.0, 1.0, 0.0)), is_static=True)
    np.testing.assert_allclose(robot.lookup('camera', 'laser', 5), (0.5, -1.0, 0.0), atol=1e-9)


def test_a_frame_is_itself_at_every_time(robot):
    np.testing.assert_array_equal(robot.lookup('map', 'map', 10**18), np.zeros(3))


def test_names_of_ros_1_with_a_slash_are_the_same_frames(robot):
    np.testing.assert_array_equal(robot.lookup('/map', '/laser'), robot.lookup('map', 'laser'))


def test_a_time_after_the_newest_sample_is_an_error(robot):
    with pytest.raises(
        InputError, match=r"'base_footprint' to 'odom': the newest is 0\.500 s older"
    ):
        robot.lookup('map', 'laser', round(2.5 * SECOND_NS))


def test_a_time_before_the_oldest_sample_is_an_error(robot):
    with pytest.raises(InputError, match=r'none at 0\.500 s'):
        robot.lookup('odom', 'laser', SECOND_NS // 2)


def test_an_unknown_frame_is_named(robot):
    with pytest.raises(InputError, match="no transform from 'arm' to 'map': frame 'arm' is not"):
        robot.lookup('map', 'arm')


def test_two_trees_are_not_connected(robot):
    robot.add(transform('earth', 'sea', (0.0, 0.0, 0.0)), is_static=True)
    with pytest.raises(InputError, match='in trees that are not connected'):
        robot.lookup('map', 'sea')


def test_a_cycle_of_frames_ends():
    buffer = TransformBuffer()
    buffer.add(transform('a', 'b', (1.0, 0.0, 0.0)), is_static=True)
    buffer.add(transform('b', 'a', (1.0, 0.0, 0.0)), is_static=True)
    np.testing.assert_allclose(np.abs(buffer.lookup('a', 'b')), (1.0, 0.0, 0.0))


def test_another_parent_replaces_the_old_one(robot):
    robot.add(transform('map', 'base_footprint', (9.0, 0.0, 0.0), 2.0), is_static=False)
    np.testing.assert_allclose(robot.lookup('map', 'base_footprint'), (9.0, 0.0, 0.0))


def test_roll_of_a_laser_mounted_upside_down_is_no_heading(robot):
    message = TransformStamped(child_frame_id='under')
    message.header.frame_id = 'base_footprint'
    message.transform.rotation.x = 1.0
    message.transform.rotation.w = 0.0
    robot.add(message, is_static=True)
    np.testing.assert_allclose(robot.lookup('base_footprint', 'under'), np.zeros(3), atol=1e-9)


def test_an_invalid_transform_is_refused_with_its_frame(robot):
    message = transform('map', 'odom', (math.nan, 0.0, 0.0), 4.0)
    with pytest.raises(InputError, match="transform to 'odom'"):
        robot.add(message, is_static=False)
    message = transform('map', 'odom', (0.0, 0.0, 0.0), 4.0)
    message.transform.rotation.w = 0.5
    with pytest.raises(InputError, match='expected norm 1'):
        robot.add(message, is_static=False)


def test_time_zero_is_a_time_and_static_transforms_alone_have_none():
    buffer = TransformBuffer()
    buffer.add(transform('base_footprint', 'laser', (0.5, 0.0, 0.0)), is_static=True)
    assert buffer.latest_common_ns('base_footprint', 'laser') is None
    buffer.add(transform('odom', 'base_footprint', (1.0, 0.0, 0.0), 0.0), is_static=False)
    assert buffer.latest_common_ns('odom', 'laser') == 0


def test_transforms_wake_no_node_and_lookups_read_them(ros_domain):
    rclpy.init(args=[])
    node = rclpy.create_node('some')
    executor = NodeExecutor(node)
    listener = TransformListener(node)
    publisher = node.create_publisher(TFMessage, '/tf', qos.TRANSFORMS)
    sent = [transform('map', 'odom', (float(second), 0.0, 0.0), second) for second in range(1, 50)]
    try:
        while publisher.get_subscription_count() < 1:
            executor.next_callback(timeout_s=0.01)
        for each in sent:
            publisher.publish(TFMessage(transforms=[each]))
        assert executor.next_callback(timeout_s=0.2) is None
        _wait_for(listener, 49.0)
        np.testing.assert_allclose(listener.lookup('map', 'odom', 45 * SECOND_NS), (45.0, 0.0, 0.0))
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


def _wait_for(listener, x):
    for _ in range(1000):
        try:
            if listener.lookup('map', 'odom')[0] == x:
                return
        except InputError:
            pass
        time.sleep(0.01)
    pytest.fail('never')
