"""The node markers on a live graph: it shows what is latched, and no NaN."""

import math

import pytest
from fuzz.strange_messages import is_rejected, made, numbers
from visualization_msgs.msg import MarkerArray

from thinmap_msgs.msg import TopologicalMap
from thinmap_ros.ros import qos

pytestmark = pytest.mark.live


def test_the_node_shows_what_is_latched_and_no_nan(graph):
    said = graph.node.create_publisher(TopologicalMap, 'topology', qos.LATCHED)
    messages_made = made(TopologicalMap, 60)
    good = [m for m in messages_made if not is_rejected(m) and not any(m.node_kinds)]
    said.publish(good[0])
    graph.start('markers')
    shown = graph.heard('topology_markers', MarkerArray, qos.LATCHED)
    graph.until(lambda: shown, 'the graph of before')
    for message in [*messages_made, good[-1]]:
        said.publish(message)
        graph.executor.spin_once(timeout_sec=0.01)
    graph.until(lambda: {'nodes', 'edges'} <= {m.ns for m in shown[-1].markers}, 'the last graph')
    assert all(math.isfinite(number) for array in shown for number in numbers(array))
    assert graph.stop('markers') == 0
