"""Edges as arrays, against edges as objects."""

from dataclasses import replace

import numpy as np

from thinmap_ros.core.slam.graph.pose_graph import Edge, EdgeArrays, Systematic
from thinmap_ros.core.slam.graph.tables import EdgeTable


def some_edges(rng, number=30):
    return [
        Edge(
            k,
            k + 1,
            rng.normal(0.0, 1.0, 3),
            np.diag(rng.uniform(1.0, 9.0, 3)),
            bool(k % 2),
            Systematic(rng.normal(0.0, 1.0, (3, 4)), rng.normal(0.0, 1.0, 4), k % 3),
            0.25 * (k % 4),
        )
        for k in range(number)
    ]


def assert_same(found, edge):
    assert (found.a, found.b, found.robust) == (edge.a, edge.b, edge.robust)
    assert found.inlier_ratio == edge.inlier_ratio
    assert found.systematic.spans == edge.systematic.spans
    for one, other in (
        (found.T_a_b, edge.T_a_b),
        (found.information, edge.information),
        (found.systematic.derivative, edge.systematic.derivative),
        (found.systematic.parameters, edge.systematic.parameters),
    ):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_edges_come_out_as_they_went_in(rng):
    edges = some_edges(rng)
    table = EdgeTable(edges[:20])
    table.extend(edges[20:])
    assert len(table) == len(list(table)) == len(edges)
    for found, edge in zip(table, edges, strict=True):
        assert_same(found, edge)
    assert_same(table[-1], edges[-1])
    assert [edge.a for edge in table[25:]] == [25, 26, 27, 28, 29]
    assert not EdgeTable() and len(EdgeTable().arrays()) == 0


def test_an_edge_that_was_read_does_not_change_with_the_table(rng):
    (edge,) = some_edges(rng, 1)
    table = EdgeTable([edge])
    read = table[0]
    table.calibrate(rng.normal(0.0, 1.0, (3, 4)))
    assert_same(read, edge)


def test_calibrated_edges_have_the_change_of_their_share(rng):
    edges = some_edges(rng)
    parameters = rng.normal(0.0, 1.0, (3, 4))
    expected = [
        replace(
            edge,
            T_a_b=edge.T_a_b + edge.systematic.change(parameters),
            systematic=edge.systematic.calibrated(parameters),
        )
        for edge in edges
    ]
    table = EdgeTable(edges)
    foreseen = table.arrays(parameters)
    np.testing.assert_array_equal(table.arrays().T_a_b, EdgeArrays.of(edges).T_a_b)
    table.calibrate(parameters)
    for found, edge in zip(table, expected, strict=True):
        assert_same(found, edge)
    np.testing.assert_array_equal(foreseen.T_a_b, table.arrays().T_a_b)
    table.calibrate(parameters)  # they are already
    for found, edge in zip(table, expected, strict=True):
        assert_same(found, edge)


def test_settled_edges_are_as_the_poses_have_them(rng):
    poses = np.column_stack([rng.uniform(-5.0, 5.0, (31, 2)), rng.uniform(-3.0, 3.0, 31)])
    edges = some_edges(rng)
    settled = EdgeArrays.of(edges).settled(poses)
    again = settled.settled(poses)
    np.testing.assert_allclose(again.T_a_b, settled.T_a_b, atol=1e-12)
    for k, edge in enumerate(edges):
        weight = edge.weight_at(settled.T_a_b[k])
        np.testing.assert_allclose(settled.information[k], weight * edge.information)
    assert (settled.information[1] < edges[1].information)[0, 0]
