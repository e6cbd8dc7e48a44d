"""Markers for RViz and Foxglove: they show the contents of the messages."""

import math

import numpy as np
import pytest
from fuzz.strange_messages import is_rejected, made
from visualization_msgs.msg import Marker

from thinmap_msgs.msg import EndNode, EndNodeArray, LineFeature, LineFeatureArray, TopologicalMap
from thinmap_ros.core.errors import InputError
from thinmap_ros.nodes import markers


def by_name(array):
    assert array.markers[0].action == Marker.DELETEALL
    return {marker.ns: marker for marker in array.markers[1:]}


def test_a_graph_as_lines_and_balls():
    message = next(
        m for m in made(TopologicalMap, 20) if not is_rejected(m) and not any(m.node_kinds)
    )
    assert len(message.edge_xy) == 4
    shown = by_name(markers.topology(message))
    positions = np.reshape(message.node_xy, (-1, 2))
    np.testing.assert_array_equal([(p.x, p.y) for p in shown['nodes'].points], positions)
    assert len(shown['nodes'].colors) == 3 and len(shown['edges'].points) == 2
    assert shown['edges'].header.frame_id == 'map' and shown['edges'].type == Marker.LINE_LIST
    assert [m.action for m in markers.topology(TopologicalMap()).markers] == [Marker.DELETEALL]


def test_end_nodes_show_their_probability():
    nodes = [
        EndNode(node_id=i, position_probability=p, is_target=i == 1)
        for i, p in enumerate((0.25, 0.9))
    ]
    balls = [
        m
        for m in markers.end_nodes(EndNodeArray(end_nodes=nodes)).markers
        if m.type == Marker.SPHERE
    ]
    texts = [m.text for m in markers.end_nodes(EndNodeArray(end_nodes=nodes)).markers if m.text]
    assert (
        texts == ['0.25', '0.90']
        and balls[0].color.a < balls[1].color.a
        and balls[0].scale.x < balls[1].scale.x
    )
    assert len({(ball.ns, ball.id) for ball in balls}) == 2
    for wrong in (math.nan, math.inf, 2.0):
        with pytest.raises(InputError, match='probability of end node 7'):
            markers.end_nodes(
                EndNodeArray(end_nodes=[EndNode(node_id=7, position_probability=wrong)])
            )


def test_line_features_from_end_to_end():
    feature = LineFeature(id=4, in_local_area=True)
    feature.start.x = 1.0
    feature.end.y = 2.0
    (lines,) = by_name(markers.line_features(LineFeatureArray(features=[feature]))).values()
    assert (
        np.allclose([(p.x, p.y) for p in lines.points], [(1.0, 0.0), (0.0, 2.0)])
        and len(lines.colors) == 2
    )
    feature.end.y = math.nan
    with pytest.raises(InputError, match='line 4'):
        markers.line_features(LineFeatureArray(features=[feature]))
