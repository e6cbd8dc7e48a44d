"""The stop holds while any source says true, beyond the end of source and node, until released."""

import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Bool
from support.live_graph import graph as graph

from thinmap_msgs.srv import ReleaseStop
from thinmap_ros.core.errors import InputError
from thinmap_ros.ros import qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.private_rclpy import GID_SIZE
from thinmap_ros.ros.stop_topic import TOPIC, StopSources, StopTopic

A = bytes([1] * GID_SIZE)
B = bytes([2] * GID_SIZE)


def test_the_robot_stands_while_any_source_says_so():
    sources = StopSources()
    assert sources.add(A, (1, 10), True, '/a')
    assert not sources.add(B, (1, 20), False, '/b')
    assert not sources.add(A, (2, 30), True, '/a'), 'no news'
    assert sources.names == {A: '/a'}
    assert sources.add(A, (3, 40), False, '/a') and not sources.names


def test_a_late_copy_of_an_earlier_message_does_not_count():
    sources = StopSources()
    sources.add(A, (1, 10), True, '/a')
    sources.add(A, (2, 20), False, '/a')
    assert not sources.add(A, (1, 10), True, '/a')
    # The same GID after a restart of the process, or of one whose clock was set back.
    assert sources.add(A, (1, 30), True, '/a')
    assert sources.add(A, (2, 5), False, '/a')


def test_a_source_that_ends_at_once_is_no_news_when_its_own_message_comes():
    sources = StopSources()
    sources.add(b'own', (1, 10), True, '/navigator')
    sources.add(b'other', (1, 11), True, '/button')
    assert sources.end({b'own', b'silent'})
    assert list(sources.names.values()) == ['/button']
    assert not sources.add(b'own', (2, 20), False, '/navigator')
    assert not sources.end({b'own'})


def test_a_source_that_is_gone_is_released_by_its_name_and_no_other():
    sources = StopSources()
    sources.add(A, (1, 10), True, 'a node')
    sources.add(B, (1, 10), True, '/b')
    sources.follow({A: '/a'})
    assert sources.names == {A: '/a', B: '/b'}, 'B is gone, and says true'
    assert sources.release('/a', alive={A}) == []
    assert sources.release('/c', alive={A}) == []
    assert sources.release('', alive={A}) == ['/b']
    assert sources.release('/a', alive={}) == ['/a']


@pytest.mark.parametrize('names', [{A: '/a'}, {A: '/a', B: '/ö/b'}])
def test_sources_are_restored(names):
    sources = StopSources()
    sources.names = dict(names)
    restored = StopSources()
    restored.restore(sources.state())
    assert restored.names == names
    with pytest.raises(InputError, match='stop'):
        restored.restore({**sources.state(), 'gids': np.zeros((3, GID_SIZE), np.uint8)})
    assert restored.names == names


class Keeper:
    """A node that follows the stop, in this process; it can be killed and started again."""

    def __init__(self, domain):
        self.domain = domain
        self.executor = SingleThreadedExecutor()
        self.start()

    def start(self):
        self.reasons = ['']
        self.node = ThinmapNode('keeper')
        self.stop = StopTopic(self.node, lambda stop: self.reasons.append(stop.reason))
        self.executor.add_node(self.node)

    def kill(self):
        """Without a word: nothing is saved or deleted at the end."""
        self.executor.remove_node(self.node)
        self.node.destroy_node()

    def has(self, *words, without=()):
        self.executor.spin_once(timeout_sec=0.0)
        reason = self.reasons[-1]
        return all(word in reason for word in words) and not any(w in reason for w in without)


@pytest.fixture
def keeper(ros_domain):
    rclpy.init(domain_id=ros_domain)
    keeper = Keeper(ros_domain)
    yield keeper
    keeper.kill()
    rclpy.try_shutdown()


@pytest.mark.live
def test_a_stop_outlives_its_source_and_the_node_that_keeps_it(keeper, graph):
    sources = [graph.node.create_publisher(Bool, TOPIC, profile) for profile in (qos.LATCHED,) * 2]
    volatile = graph.node.create_publisher(Bool, TOPIC, qos.STREAM)
    client = graph.client(ReleaseStop, 'keeper/release_stop')

    def release(source):
        sent = client.call_async(ReleaseStop.Request(source=source))
        graph.until(lambda: keeper.has('') and sent.done(), 'an answer')
        return sent.result()

    sources[0].publish(Bool(data=True))
    sources[1].publish(Bool(data=False))
    volatile.publish(Bool(data=False))
    graph.until(lambda: keeper.has('/test_client', without=['gone']), 'held by one of three')
    graph.until(lambda: keeper.has('') and client.service_is_ready(), 'the service')
    assert not release('/test_client').success, 'it lives'
    keeper.kill()
    keeper.start()
    assert keeper.stop.reason, 'at once'
    graph.node.destroy_publisher(sources[0])
    graph.until(lambda: keeper.has('/test_client (gone'), 'its source is gone')
    keeper.kill()
    keeper.start()
    # Others say false; who has said true does not live any more.
    sources[1].publish(Bool(data=False))
    volatile.publish(Bool(data=False))
    graph.until(lambda: keeper.has('/test_client (gone') and client.service_is_ready(), 'kept')
    answer = release('/other')
    assert not answer.success and '/test_client' in answer.message
    answer = release('/test_client')
    assert answer.success and answer.message == 'released: /test_client'
    assert keeper.reasons[-1] == '' and not keeper.stop.reason
    keeper.kill()
    keeper.start()
    assert not keeper.stop.reason, 'for good'
    # Again and again: what it says before the new node is discovered is lost.
    said = Bool(data=True)
    graph.until(
        lambda: volatile.publish(said) or keeper.has('/test_client'), 'one that does not latch it'
    )
    volatile.publish(Bool(data=False))
    graph.until(lambda: not keeper.has('stopped'), 'released by itself')
