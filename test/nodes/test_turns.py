"""Merging and searching take turns, however long each lasts, and whatever becomes of it."""

import pytest
import rclpy
from support.timeouts import PATIENCE_S

from thinmap_ros.core.errors import InputError
from thinmap_ros.nodes.parts.joining import Turns
from thinmap_ros.ros.executor import NodeExecutor
from thinmap_ros.ros.lifecycle_node import ThinmapNode, Worker


def test_kinds_that_are_always_ready_take_turns():
    turns = Turns()
    taken = [turns.take(['merge', 'search']) for _ in range(4)]
    assert taken == ['merge', 'search', 'merge', 'search']


def test_a_kind_that_is_ready_alone_does_not_wait():
    turns = Turns()
    assert [turns.take(['merge']) for _ in range(3)] == ['merge'] * 3
    assert turns.take([]) == ''
    assert turns.take(['merge', 'search']) == 'merge'


@pytest.fixture
def node(ros_domain):
    rclpy.init(domain_id=ros_domain)
    node = ThinmapNode('worker')
    node.start()
    yield node
    node.destroy_node()
    rclpy.try_shutdown()


@pytest.mark.live
def test_work_that_fails_says_so_once_and_other_work_may_begin(node):
    def fail():
        raise InputError('planted')

    executor = NodeExecutor(node)
    failed = []
    taken = []

    def work_until(condition):
        while not condition():
            ready = executor.next_callback(PATIENCE_S)
            if ready is not None:
                ready.call()

    worker = Worker(node, 1.0, failed.append)
    assert not worker.is_busy
    worker.begin(fail)
    assert worker.is_busy
    work_until(lambda: failed)
    assert not worker.is_busy
    worker.begin(lambda: lambda: taken.append('dropped'))
    worker.drop()
    worker.begin(lambda: lambda: taken.append('other'))
    work_until(lambda: taken)
    assert taken == ['other'] and [str(error) for error in failed] == ['planted']
    executor.shutdown()
