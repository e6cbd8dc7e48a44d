"""What recognition needs of a map grows with it: nothing that is made is made again."""

from collections import Counter

import numpy as np
import pytest
from support.carried_robot import carried

from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.slam.joining.pieces import GrowingPiece
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.topology.topology import TopologyBuilder


@pytest.fixture
def calls(monkeypatch):
    """How often a graph was updated, and each keyframe added to a piece, by number."""
    calls = Counter()
    add = GrowingPiece.add
    update = TopologyBuilder.update

    def counting_add(self, number, frames):
        calls[number] += 1
        add(self, number, frames)

    def counting_update(self, window, T_map_base):
        calls['graph'] += 1
        return update(self, window, T_map_base)

    monkeypatch.setattr(GrowingPiece, 'add', counting_add)
    monkeypatch.setattr(TopologyBuilder, 'update', counting_update)
    return calls


def test_a_second_search_adds_only_what_is_new_in_the_published_map(calls):
    localizer = Localizer(LocalizerConfig(map_tag='first'))
    storeys = {1: 'second', 3: 'third'}
    drive = 0
    for moment in carried((9, 0, 25.0), (3, 1, 10.0), (9, 0, 15.0), (4, 1, 10.0)):
        if moment.drive != drive:
            drive = moment.drive
            if drive in storeys:
                localizer.enter_storey(storeys[drive])
            else:  # back at the start
                localizer.set_pose(np.zeros(3), np.diag([0.01, 0.01, 0.01]))
        localizer.step(moment.scan, moment.T_odom_base)
    is_published = localizer._loops.pieces.is_published
    frames = enumerate(localizer.keyframes)
    published = [k for k, frame in frames if is_published(frame.submap)]
    assert len(published) > 20
    assert {calls[k] for k in published} == {1}


def test_the_graph_of_a_piece_follows_with_its_views_and_is_that_of_each_keyframe(calls):
    localizer = Localizer()
    for moment in carried((9, 0, 25.0)):
        localizer.step(moment.scan, moment.T_odom_base)
    piece = GrowingPiece()
    grid = OccupancyGrid(OccupancyConfig(resolution_m=0.1))
    of_each = TopologyBuilder()
    for number, frame in enumerate(localizer.keyframes):
        before = calls['graph']
        piece.add(number, localizer.keyframes)
        calls['views'] += calls['graph'] - before
        grid.add_scan(frame.scan, frame.T_map_base)
        of_each.update(grid.take_changes(), frame.T_map_base)
    assert 3 < calls['views'] == len(piece.views) < len(piece.frames) // 2
    assert places(piece.map_piece().graph) == places(of_each.map)


def places(graph):
    return {(round(node.x, 3), round(node.y, 3)) for node in graph.nodes.values()}
