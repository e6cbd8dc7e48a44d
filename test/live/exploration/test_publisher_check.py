"""Whether somebody publishes a topic, with the remapping rules of the node that asks."""

import pytest
from rclpy.node import Node
from std_msgs.msg import String

from thinmap_ros.nodes.parts.observation import PublisherCheck

pytestmark = pytest.mark.live


def test_a_publisher_is_found_under_the_name_that_the_topic_is_remapped_to(graph):
    rules = ['--ros-args', '-r', 'grid:=shared/grid']
    node = Node('asks', context=graph.context, cli_args=rules)
    try:
        check = PublisherCheck(node, 'local_grid', 'grid')
        assert not check.is_found()
        publisher = graph.node.create_publisher(String, 'shared/grid', 1)
        graph.until(check.is_found, 'the publisher is found')
        graph.node.destroy_publisher(publisher)
        graph.until(lambda: not check.is_found(), 'the publisher is gone')
        check.message_received()
        assert check.is_found()
    finally:
        node.destroy_node()


def test_a_publisher_of_the_name_before_remapping_does_not_count(graph):
    rules = ['--ros-args', '-r', 'grid:=shared/grid']
    node = Node('asks', context=graph.context, cli_args=rules)
    try:
        graph.node.create_publisher(String, 'grid', 1)
        graph.until(lambda: node.count_publishers('/grid') > 0, 'the publisher is discovered')
        assert not PublisherCheck(node, 'grid').is_found()
    finally:
        node.destroy_node()
