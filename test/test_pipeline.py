"""What the pipeline puts on the map."""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from support.slam_room import ROOM, drive_round_the_block, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.ekf_localizer import EkfConfig
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.stage import Estimate
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap
from thinmap_ros.pipeline import Pipeline, PipelineConfig

HERE = se2.pose(2.0, 2.0, 0.0)


@pytest.mark.parametrize(
    ('state', 'is_mapped'),
    [({}, True), ({'is_lost': True}, False), ({'blind_reason': 'no returns'}, False)],
)
def test_scans_of_a_lost_robot_or_a_blind_laser_change_no_cell(state, is_mapped):
    known = Estimate(HERE, np.zeros((3, 3)), HERE)
    estimates = [known, replace(known, **state)]
    pipeline = Pipeline(pose_source=lambda scan, T_odom_base: estimates.pop(0))
    wall = scan_in(ROOM, HERE)
    pipeline.step(wall, HERE)
    before = pipeline.grid.known_area()
    pipeline.step(replace(wall, ranges_m=np.full_like(wall.ranges_m, np.inf)), HERE)
    after = pipeline.grid.known_area()
    is_same = before.shape == after.shape and bool((before.cells == after.cells).all())
    assert is_same != is_mapped


def places_of(graph: TopologicalMap) -> tuple[list[object], list[object]]:
    """Kinds and places of the nodes, and of both ends of the edges: ids are of no account."""
    nodes = {n.id: (n.kind.name, round(n.x, 6), round(n.y, 6)) for n in graph.nodes.values()}
    edges = [sorted((nodes[e.a], nodes[e.b])) for e in graph.edges.values()]
    return sorted(nodes.values()), sorted(edges)


def round_the_block(scans_per_graph: int = 1) -> Iterator[Pipeline]:
    """A pipeline after each scan of a lap that is long enough to drift, and after the last one."""
    start = LocalizerConfig(initial_x_m=3.0, initial_y_m=1.2)
    pipeline = Pipeline(PipelineConfig(start, PAPER_GRID, scans_per_graph=scans_per_graph))
    for scan, odom, _ in islice(drive_round_the_block(), 0, None, 3):
        pipeline.step(scan, odom)
        yield pipeline
    pipeline.finish()
    yield pipeline


@pytest.mark.cpu_budget(20.0, 'three laps with loops')
def test_the_graph_is_the_same_whenever_it_is_asked_for_and_nodes_keep_their_ids() -> None:
    (late,) = deque(round_the_block(), maxlen=1)
    assert late.corrections and not {'topology', 'rebuild'} & late.stage_seconds.keys()
    for pipeline in round_the_block():
        graph = pipeline.topology.map
    every = pipeline.stage_seconds
    assert len(every['topology']) + len(every['rebuild']) > len(every['grid']) / 2
    half = len(every['grid']) // 2
    for number, sometimes in enumerate(round_the_block()):
        if number == half:
            before = sometimes.topology.map.copy()
    assert late.corrections == pipeline.corrections > 0
    assert places_of(late.topology.map) == places_of(graph) == places_of(sometimes.topology.map)
    last = sometimes.topology.map.nodes
    corners = [node for node in before.nodes.values() if node.kind is NodeKind.CORNER]
    away_m = [math.dist(node.position, last[node.id].position) for node in corners]
    assert 0.3 < max(away_m) < 2.0, 'the correction has moved them, and they have their ids'
    assert late.topology is late.topology
    assert len(late.stage_seconds['rebuild']) == 1, 'asked for again, it is not made again'


def test_a_filter_is_given_the_graph_of_each_scan() -> None:
    pipeline = Pipeline(PipelineConfig(EkfConfig()))
    for k in range(3):
        pipeline.step(scan_in(ROOM, HERE, None, k + 1), HERE)
    assert len(pipeline.stage_seconds['topology']) == 3
