"""Benchmark of place recognition: recorded pieces, their errors against the truth, and tables."""

import numpy as np
import pytest
from support.driven_pieces import driven_piece

from benchmarks.places import tables
from benchmarks.places.generators import generators
from benchmarks.places.pieces import (
    RecordedPiece,
    rigid_errors,
    with_shared_ground,
    without_shared_ground,
)
from benchmarks.rows import shown
from thinmap_ros.core import se2


def recorded(name, *drive):
    driven = driven_piece(*drive)
    piece = driven.piece
    truth = np.array([se2.compose(driven.T_world_piece, f.T_map_base) for f in piece.keyframes])
    return RecordedPiece(name, list(piece.keyframes), driven.edges, piece.patch, piece.graph, truth)


@pytest.fixture(scope='module')
def pieces():
    return [recorded('one.a', 1, 1), recorded('one.b', 1, 2), recorded('other.a', 11, 1)]


def test_a_piece_is_read_as_it_was_written(pieces, tmp_path):
    piece = pieces[0]
    piece.save(tmp_path)
    read = RecordedPiece.load(tmp_path, piece.name)
    np.testing.assert_array_equal(read.poses, piece.poses)
    np.testing.assert_array_equal(read.truth, piece.truth)
    np.testing.assert_array_equal(read.patch.cells, piece.patch.cells)
    assert read.graph.nodes.keys() == piece.graph.nodes.keys()
    assert [(edge.a, edge.b) for edge in read.edges] == [(edge.a, edge.b) for edge in piece.edges]
    for own, other in zip(read.frames, piece.frames, strict=True):
        np.testing.assert_array_equal(own.scan.ranges_m, other.scan.ranges_m)
        np.testing.assert_allclose(own.points, other.points)


def test_pairs_are_of_one_building_or_of_two(pieces):
    shared = [(known.name, query.name) for known, query in with_shared_ground(pieces)]
    assert shared == [('one.a', 'one.b'), ('one.b', 'one.a')]
    assert len(without_shared_ground(pieces)) == 4


def test_the_true_transform_has_no_error(pieces):
    known, query = pieces[:2]
    T = se2.between(driven_piece(1, 1).T_world_piece, driven_piece(1, 2).T_world_piece)
    errors = rigid_errors(known, query, T)
    assert len(errors) > 20
    assert errors.max() < 1e-9
    assert rigid_errors(known, query, T + (0.3, 0.0, 0.0)) == pytest.approx(0.3)


def test_tables_say_what_is_joined(pieces):
    shared = tables.shared(pieces).rows
    assert [row[0] for row in shared] == ['one.a <- one.b', 'one.b <- one.a']
    assert all(row[1] <= row[2] and row[6] < 0.1 for row in shared)
    foreign = tables.foreign(pieces).rows
    assert foreign[0][:2] == ['4 pairs: joined', 0]
    (joined,) = tables.joined(pieces).rows
    assert joined[1] > 10
    assert joined[4] < 0.05
    assert all(row[1] == row[2] for row in tables.bare(pieces).rows)


def test_nodes_are_compared_with_random_places(pieces):
    table = generators(pieces)
    shares = {row[1]: row[3] for row in table.rows}
    assert shares['pairs of branch nodes'] > shares['random places, as many as nodes']
    assert '| pair |' in shown(table)
