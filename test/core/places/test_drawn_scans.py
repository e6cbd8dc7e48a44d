"""Scans that are drawn from a grid along a topological map."""

import math

import numpy as np
import pytest
from support.driven_pieces import driven_piece, true_transform

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.places.piece import MapPiece, drawn_scans
from thinmap_ros.core.places.recognition import recognize
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap


def one_edge(*points):
    path = np.array(points)
    nodes = [Node(1, NodeKind.END, *points[0], 1.0), Node(2, NodeKind.END, *points[-1], 1.0)]
    length = float(np.hypot(*np.diff(path, axis=0).T).sum())
    return TopologicalMap(nodes, [Edge(3, 1, 2, path, length, 1.0)])


@pytest.fixture
def room():
    """6 m by 4 m, with the right half unknown."""
    cells = np.zeros((42, 62), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    cells[1:-1, 30:61] = UNKNOWN
    return GridPatch(GridFrame(-0.1, -0.1, 0.1), cells)


def test_ranges_are_those_of_the_walls(room):
    scan = drawn_scans(room, one_edge((1.0, 2.0), (2.0, 2.0)))[0].scan
    by_degrees = {round(math.degrees(angle)): k for k, angle in enumerate(scan.angles_rad)}
    assert scan.ranges_m[by_degrees[-180]] == pytest.approx(1.0, abs=1e-5)
    assert scan.ranges_m[by_degrees[90]] == pytest.approx(2.0, abs=1e-5)
    assert scan.ranges_m[by_degrees[-90]] == pytest.approx(2.0, abs=1e-5)
    assert scan.ranges_m[by_degrees[-150]] == pytest.approx(1.0 / math.cos(math.pi / 6), abs=1e-5)


def test_beams_into_the_unknown_are_invalid(room):
    scan = drawn_scans(room, one_edge((1.0, 2.0), (2.0, 2.0)))[0].scan
    ahead = np.abs(scan.angles_rad) < 0.5
    assert not scan.valid[ahead].any()


def test_a_beam_without_a_wall_in_range_has_no_return():
    cells = np.zeros((10, 400), dtype=np.int8)
    scan = drawn_scans(
        GridPatch(GridFrame(0.0, 0.0, 0.1), cells), one_edge((20.0, 0.5), (21.0, 0.5))
    )[0].scan
    assert scan.no_return[np.abs(scan.angles_rad) < 0.02].all()


def test_scans_are_spaced_along_the_path(room):
    scans = drawn_scans(room, one_edge((1.0, 1.0), (2.0, 1.0), (2.0, 3.0)))
    assert len(scans) == 5
    np.testing.assert_allclose(scans[2].T_map_base, [2.0, 1.4, 0.0])


def test_a_walk_takes_each_edge_once_and_goes_on_where_it_is():
    nodes = [Node(k, NodeKind.END, float(k), 0.0, 1.0) for k in (1, 2, 3)]
    path = np.array([[1.0, 0.0], [2.0, 0.0]])
    edges = [Edge(9, 2, 1, path[::-1], 1.0, 1.0), Edge(5, 3, 2, path[::-1] + (1.0, 0.0), 1.0, 1.0)]
    cells = np.zeros((30, 60), dtype=np.int8)
    patch = GridPatch(GridFrame(0.0, -1.5, 0.1), cells)
    scans = drawn_scans(patch, TopologicalMap(nodes, edges))
    assert [round(scan.T_map_base[0], 1) for scan in scans] == [3.0, 2.3, 2.0, 1.3]


def bare(piece):
    return MapPiece(drawn_scans(piece.patch, piece.graph), piece.patch, piece.graph)


def test_bare_maps_are_recognized_and_foreign_ones_are_not():
    known, query, foreign = (driven_piece(*key) for key in ((3, 1), (3, 2), (13, 1)))
    pieces = [bare(one.piece) for one in (known, query, foreign)]
    decision = recognize(pieces[1], pieces[0])
    assert decision.is_joined
    off = se2.between(true_transform(known, query), decision.placement.T_map_piece)
    assert np.hypot(off[0], off[1]) < 0.1
    assert abs(off[2]) < 0.01
    assert not recognize(pieces[2], pieces[0]).is_joined
