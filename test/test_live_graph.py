"""`support.live_graph`: the client of a live graph."""

import threading

import pytest
from std_msgs.msg import String
from support.live_graph import graph as graph

pytestmark = pytest.mark.live


def test_what_was_published_before_is_heard_though_others_never_pause(graph):
    heard = graph.heard('a', String)
    graph.heard('b', String)
    before = graph.node.create_publisher(String, 'a', 100)
    others = graph.node.create_publisher(String, 'b', 100)
    is_over = threading.Event()

    def publish():
        while not is_over.wait(2e-3):
            others.publish(String())

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        for _ in range(50):
            before.publish(String())
        graph.drain()
    finally:
        is_over.set()
        thread.join()
    assert len(heard) == 50
