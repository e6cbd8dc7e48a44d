"""Rooms on a live graph: topology_builder publishes them with the nodes of its graph."""

import time
from dataclasses import replace

import numpy as np
import pytest
from core.topology.floors import office, patch_of
from support.localized import local_grid
from visualization_msgs.msg import MarkerArray

from thinmap_msgs.msg import LocalGrid, ProbabilityGrid, Region, RegionArray, TopologicalMap
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
S = 1_000_000_000
HERE = np.array([3.0, 3.2, 0.0])


def test_regions_name_the_nodes_of_the_graph(graph):
    patch = patch_of(office())
    grids = graph.node.create_publisher(ProbabilityGrid, 'grid', qos.LATCHED)
    windows = graph.node.create_publisher(LocalGrid, 'local_grid', qos.LATCHED)
    heard = graph.heard('regions', RegionArray, qos.LATCHED)
    graphs = graph.heard('topology', TopologicalMap, qos.LATCHED)
    markers = graph.heard('regions_markers', MarkerArray, qos.LATCHED)
    graph.start('topology_builder', region_update_period_s=0.2)
    graph.start('markers')
    ns = S
    # Once, as a mapper publishes a grid that does not change: the graph is newer.
    grids.publish(messages.probability_grid_msg(patch, 'map', ns))

    def is_complete():
        nonlocal ns
        ns += S
        windows.publish(local_grid(patch, HERE, ns))
        return (
            graphs
            and heard
            and set(graphs[-1].node_ids) == {i for r in heard[-1].regions for i in r.node_ids}
            and len(graphs[-1].node_ids) > 0
        )

    graph.until(is_complete, 'regions of all nodes')
    message = heard[-1]
    assert message.header.frame_id == 'map'
    assert sorted(r.kind for r in message.regions) == [Region.ROOM, Region.ROOM, Region.CORRIDOR]
    edges = set(graphs[-1].edge_ids)
    assert {number for r in message.regions for number in r.edge_ids} == edges
    assert len(message.doors) == 2
    assert all(door.edge_ids and set(door.edge_ids) <= edges for door in message.doors)
    graph.until(lambda: markers and len(markers[-1].markers) == 6, 'outlines, doors and names')
    assert graph.stop('topology_builder') == graph.stop('markers') == 0


def test_regions_are_computed_where_cells_have_changed(graph):
    patch = patch_of(office())
    grids = graph.node.create_publisher(ProbabilityGrid, 'grid', qos.LATCHED)
    heard = graph.heard('regions', RegionArray, qos.LATCHED)
    graph.start('topology_builder', region_update_period_s=0.1)
    grids.publish(messages.probability_grid_msg(patch, 'map', S))
    graph.until(lambda: heard, 'regions')
    # More certainly free than before: the same cells are free.
    surer = replace(patch, cells=np.where(patch.free, patch.cells + 1, patch.cells).astype(np.int8))
    assert np.array_equal(surer.free, patch.free) and not np.array_equal(surer.cells, patch.cells)
    for ns, same in ((2 * S, patch), (3 * S, surer)):
        grids.publish(messages.probability_grid_msg(same, 'map', ns))
        # Long enough to compute them, unless the machine is slow: then this test sees less.
        until = time.monotonic() + 1.0
        graph.until(lambda until=until: time.monotonic() > until, 'some periods')
    assert len(heard) == 1
    # Without its lower rooms.
    half = replace(patch, cells=patch.cells.copy())
    half.cells[: half.shape[0] // 2] = -1
    grids.publish(messages.probability_grid_msg(half, 'map', 4 * S))
    graph.until(lambda: len(heard) == 2, 'regions of the other map')
    assert messages.stamp_ns(heard[1].header.stamp) == 4 * S
    assert len(heard[1].regions) < len(heard[0].regions)
    assert graph.stop('topology_builder') == 0
