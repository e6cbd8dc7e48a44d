"""topology_builder publishes graphs that changed, and the local one for each scan of a listener."""

import numpy as np
import pytest
from support.doctor import Doctor
from support.localized import local_grid

from thinmap_msgs.msg import LocalGrid, TopologicalMap
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
HERE = np.array([1.0, 1.0, 0.0])


def corridor(length_m):
    """A corridor of 2 m width in a window of 20 m."""
    cells = np.full((40, 200), 100, dtype=np.int8)
    cells[5:25, 2 : round(10.0 * length_m)] = 0
    return GridPatch(GridFrame(0.0, -0.5, 0.1), cells)


class Scans:
    """Windows of a map with the robot's scan, a second apart, each until the builder has it."""

    def __init__(self, graph):
        self._graph = graph
        self._doctor = Doctor(graph)
        self._windows = graph.node.create_publisher(LocalGrid, 'local_grid', qos.STREAM)
        graph.until(self._windows.get_subscription_count, 'a builder that listens')
        self.count = 0

    def add(self, patch, number):
        for _ in range(number):
            self.count += 1
            ns = self.count * SECOND_NS
            self._windows.publish(local_grid(patch, HERE, ns))
        self._graph.until(
            lambda: self._doctor.number('topology_builder', 'local_grid: received') == self.count,
            'scans that are processed',
        )


def seconds(graphs):
    return [message.header.stamp.sec for message in graphs]


def test_a_graph_that_stays_is_published_once_and_the_local_one_for_each_scan_of_a_listener(graph):
    graphs = graph.heard('topology', TopologicalMap, qos.LATCHED)
    graph.start('topology_builder')
    scans = Scans(graph)
    scans.add(corridor(10.0), 5)
    graph.until(lambda: graphs, 'the graph')
    # Nobody listened: the local graph of the first scan is latched, and nothing has changed since.
    local = graph.heard('local_topology', TopologicalMap, qos.LATCHED)
    graph.until(lambda: local, 'what is latched')
    assert seconds(local) == [1] and len(local[0].edge_ids) > 0
    scans.add(corridor(10.0), 3)
    graph.until(lambda: seconds(local) == [1, 6, 7, 8], 'the answer to each scan')
    assert messages.is_same_topology(local[-1], local[0])
    assert seconds(graphs) == [1]
    scans.add(corridor(15.0), 2)
    graph.until(lambda: seconds(local)[-2:] == [9, 10], 'the answer to each scan')
    graph.until(lambda: seconds(graphs) == [1, 9], 'the graph that has changed')
    assert not messages.is_same_topology(graphs[0], graphs[1])
    assert graph.stop('topology_builder') == 0
