"""Two pieces joined: poses, grid, and the ids of the topological map."""

import numpy as np
import pytest
from support.driven_pieces import driven_piece, true_transform

from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import OccupancyConfig
from thinmap_ros.core.places.recognition import recognize
from thinmap_ros.core.slam.joining.join import join, match_keyframes, placed_keyframes
from thinmap_ros.core.slam.joining.pieces import SlamPiece
from thinmap_ros.core.topology.graph import NodeKind

CONFIG = OccupancyConfig(no_return_clear_range_m=8.0)
DRIFT = 0.01  # m of error per metre of path


def piece_of(driven, next_id=1000):
    piece = driven.piece
    return SlamPiece(piece.keyframes, driven.edges, piece.patch, piece.graph, next_id)


def bare(driven):
    return SlamPiece.of_bare_map(driven.piece.patch, driven.piece.graph)


def placed(first, second):
    decision = recognize(second.places, first.places)
    assert decision.is_joined
    return decision.placement


def joined(first, second):
    return join(first, second, placed(first, second), CONFIG)


def true_poses(driven):
    """Poses (N, 3) of the keyframes in the frame of the first piece of the building."""
    return np.array([frame.T_map_base for frame in driven.piece.keyframes])


@pytest.fixture(scope='module')
def drives():
    return driven_piece(1, 1), driven_piece(1, 2), driven_piece(1, 2, drift=DRIFT)


@pytest.fixture(scope='module')
def bent(drives):
    return joined(piece_of(drives[0]), piece_of(drives[2]))


def test_a_bent_piece_is_straightened_by_the_other_one(drives, bent):
    first, straight, query = drives
    count = len(first.piece.keyframes)
    T = true_transform(first, straight)
    truth = np.array([se2.compose(T, own) for own in true_poses(straight)])
    before = np.array([se2.compose(bent.T_first_second, own) for own in true_poses(query)])
    errors = [np.hypot(*(poses - truth)[:, :2].T) for poses in (before, bent.piece.poses[count:])]
    assert errors[0].max() > 0.3
    assert errors[1].max() < 0.12
    assert np.median(errors[1]) < 0.04
    np.testing.assert_allclose(bent.piece.poses[0], first.piece.keyframes[0].T_map_base)


def test_the_joined_grid_holds_both(drives, bent):
    first, second, _ = drives
    patch = bent.piece.patch
    for driven, T in ((first, np.zeros(3)), (second, true_transform(first, second))):
        cells = np.argwhere(driven.piece.patch.free)
        points = se2.transform_points(T, driven.piece.patch.frame.centres_of(cells))
        rows, cols = patch.frame.cells_of(points).T
        assert patch.free[rows, cols].mean() > 0.85


def test_ids_of_the_first_map_stay_and_none_is_twice(bent, drives):
    first, _, query = drives
    graph = bent.piece.graph
    branches = [n for n in first.piece.graph.nodes.values() if n.kind is NodeKind.BRANCH]
    kept = [
        node
        for node in branches
        if node.id in graph.nodes
        and np.hypot(*(graph.nodes[node.id].position - node.position)) < 0.5
    ]
    assert len(kept) >= 0.6 * len(branches)
    own = set(first.piece.graph.nodes) | set(first.piece.graph.edges)
    new = (set(graph.nodes) | set(graph.edges)) - own
    assert min(new) >= 1000
    assert len(set(bent.ids.values())) == len(bent.ids) > 0
    assert set(bent.ids.values()) <= set(graph.nodes)
    assert set(bent.ids) <= set(query.piece.graph.nodes)
    assert bent.piece.next_id > max(max(graph.nodes), max(graph.edges))


def test_the_topology_continues_from_the_joined_grid(bent):
    """An update with the same grid changes nothing."""
    before = dict(bent.topology.map.nodes)
    T = bent.piece.poses[-1]
    bent.topology.update(bent.piece.patch, T)
    assert bent.topology.map.nodes == before


def test_bare_maps_are_joined_rigidly(drives):
    first, second, _ = drives
    result = joined(bare(first), bare(second))
    off = se2.between(true_transform(first, second), result.T_first_second)
    assert np.hypot(off[0], off[1]) < 0.05
    assert abs(off[2]) < 0.005
    assert result.piece.is_rigid
    assert result.links > 10
    known = first.piece.patch.cells != -1
    row, col = result.piece.patch.offset_of(first.piece.patch)
    rows, cols = first.piece.patch.shape
    part = result.piece.patch.cells[row : row + rows, col : col + cols]
    np.testing.assert_array_equal(part[known], first.piece.patch.cells[known])
    assert result.piece.patch.free.sum() > 1.05 * first.piece.patch.free.sum()


def test_a_piece_with_keyframes_and_a_bare_map_are_joined(drives):
    first, second, _ = drives
    for one, other in ((piece_of(first), bare(second)), (bare(first), piece_of(second))):
        result = joined(one, other)
        off = se2.between(true_transform(first, second), result.T_first_second)
        assert np.hypot(off[0], off[1]) < 0.05
        assert result.piece.is_rigid


def test_a_joined_piece_is_joined_with_a_third_one(bent):
    third = driven_piece(1, 3)
    result = joined(bent.piece, piece_of(third))
    assert result.links > 10
    off = se2.between(true_transform(driven_piece(1, 1), third), result.T_first_second)
    assert np.hypot(off[0], off[1]) < 0.1


def test_keyframes_are_matched_one_at_a_time(drives):
    """A caller does one match, and another one later."""
    first, second, _ = drives
    placement = placed(piece_of(first), piece_of(second))
    query = piece_of(second)
    priors = list(placed_keyframes(query.frames, query.places.views, placement.hypothesis))
    frames = (first.piece.keyframes, second.piece.keyframes)
    matching = match_keyframes(*frames, priors)
    link = next(link for link in matching if link is not None)
    T = se2.compose(first.piece.keyframes[link.a].T_map_base, link.T_a_b)
    own = second.piece.keyframes[link.b].T_map_base
    off = se2.between(se2.compose(true_transform(first, second), own), T)
    assert np.hypot(off[0], off[1]) < 0.05
    assert len(list(matching)) > 10


def test_keyframes_at_a_wrong_place_are_not_linked(drives):
    first, second, _ = drives
    priors = [
        (k, frame.T_map_base + (1.0, 0.7, 1.6)) for k, frame in enumerate(first.piece.keyframes)
    ]
    links = list(match_keyframes(first.piece.keyframes, first.piece.keyframes, priors))
    assert sum(link is not None for link in links) < 0.2 * len(links)
    far = [(0, np.array([500.0, 0.0, 0.0]))]
    assert not list(match_keyframes(first.piece.keyframes, second.piece.keyframes, far))
