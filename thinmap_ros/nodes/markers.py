"""Graph, regions, end nodes and line features as markers, for RViz and Foxglove."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from thinmap_msgs.msg import EndNodeArray, LineFeatureArray, RegionArray, TopologicalMap
from thinmap_ros.core import errors
from thinmap_ros.core.topology.graph import NodeKind, topology_from_msg
from thinmap_ros.logs import decode
from thinmap_ros.ros import node_main, parameters, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import subscribe_guarded
from thinmap_ros.view import palette

_END = palette.NODES[NodeKind.END]
_REMOTE = '#999999'
_TEXT_COLOUR = '#000000'


@dataclass(frozen=True)
class _Style:
    """Size of a kind of marker, and its height above the map."""

    size_m: float
    z_m: float


_EDGE = _Style(size_m=0.04, z_m=0.02)
_LINE = _Style(size_m=0.06, z_m=0.04)
_REGION = _Style(size_m=0.1, z_m=0.01)
_DOOR = _Style(size_m=0.3, z_m=0.03)
_NODE = _Style(size_m=0.2, z_m=0.05)
_TEXT = _Style(size_m=0.3, z_m=0.4)


class MarkersNode(ThinmapNode):
    """/topology, /regions, /end_nodes and /line_features in; /topology_markers, ... out."""

    def __init__(self) -> None:
        super().__init__('markers')
        parameters.reject_unknown(self)
        self._show(TopologicalMap, 'topology', topology)
        self._show(RegionArray, 'regions', regions)
        self._show(EndNodeArray, 'end_nodes', end_nodes)
        self._show(LineFeatureArray, 'line_features', line_features)

    def _show(self, kind: type, topic: str, drawn: Callable[[Any], MarkerArray]) -> None:
        publisher = self.create_publisher(MarkerArray, f'{topic}_markers', qos.LATCHED)
        subscribe_guarded(
            self, kind, topic, lambda message: publisher.publish(drawn(message)), qos.LATCHED
        )


def topology(message: TopologicalMap) -> MarkerArray:
    """Edges as lines along their paths, nodes as spheres coloured by kind.

    Raises InputError as `topology_from_msg`.
    """
    graph = topology_from_msg(message)
    edges = _marker(message.header, 'edges', Marker.LINE_LIST, _EDGE.size_m, palette.EDGE)
    for edge in graph.edges.values():
        points = [_point(float(x), float(y), _EDGE.z_m) for x, y in edge.path]
        for start, end in pairwise(points):
            edges.points += [start, end]
    nodes = _marker(message.header, 'nodes', Marker.SPHERE_LIST, _NODE.size_m, palette.EDGE)
    for node in graph.nodes.values():
        nodes.points.append(_point(node.x, node.y, _NODE.z_m))
        nodes.colors.append(_colour(palette.NODES[node.kind]))
    return _shown([edges, nodes])


def regions(message: RegionArray) -> MarkerArray:
    """Outlines of regions in the colour of their kind, their ids, and doors as spheres.

    Raises InputError where a kind is unknown or a position is out of range.
    """
    outlines = _marker(message.header, 'regions', Marker.LINE_LIST, _REGION.size_m, palette.EDGE)
    names = []
    for region in decode.regions(message):
        corners = [_point(x, y, _REGION.z_m) for x, y in region.outline.tolist()]
        ends = [point for pair in pairwise([*corners, *corners[:1]]) for point in pair]
        outlines.points += ends
        outlines.colors += len(ends) * [_colour(palette.region(region.kind, region.id))]
        text = _text(message.header, 'region_names', region.id % 2**31, region.name)
        text.pose.position = _point(*region.centre, _TEXT.z_m)
        names.append(text)
    doors = _marker(message.header, 'doors', Marker.SPHERE_LIST, _DOOR.size_m, palette.ESTIMATE)
    for door in message.doors:
        place = (door.position.x, door.position.y)
        errors.require_bounded(f'door {door.region_a}-{door.region_b}', place)
        doors.points.append(_point(*place, _DOOR.z_m))
    return _shown([outlines, doors, *names])


def end_nodes(message: EndNodeArray) -> MarkerArray:
    """End nodes as spheres with their probability: more opaque if larger; the target is larger.

    Raises InputError where a position or probability is out of range.
    """
    markers: list[Marker] = []
    for node in decode.end_nodes(message):
        ball = _marker(
            message.header,
            'end_nodes',
            Marker.SPHERE,
            _NODE.size_m * (2.0 if node.is_target else 1.2),
            _END,
        )
        ball.id = len(markers)
        ball.color.a = 0.3 + 0.7 * node.probability
        ball.pose.position = _point(node.x, node.y, _NODE.z_m)
        text = _text(message.header, 'probabilities', len(markers), f'{node.probability:.2f}')
        text.pose.position = _point(node.x, node.y, _TEXT.z_m)
        markers += [ball, text]
    return _shown(markers)


def line_features(message: LineFeatureArray) -> MarkerArray:
    """Line features, those of the local area in another colour.

    Raises InputError where an end point is out of range.
    """
    lines = _marker(message.header, 'lines', Marker.LINE_LIST, _LINE.size_m, palette.ESTIMATE)
    for feature in message.features:
        ends = (feature.start, feature.end)
        errors.require_bounded(f'line {feature.id}', [c for end in ends for c in (end.x, end.y)])
        lines.points += [_point(end.x, end.y, _LINE.z_m) for end in ends]
        lines.colors += 2 * [_colour(palette.ESTIMATE if feature.in_local_area else _REMOTE)]
    return _shown([lines])


def _shown(markers: list[Marker]) -> MarkerArray:
    """Markers that replace all shown before, without empty lists, which RViz rejects."""
    lists = (Marker.LINE_LIST, Marker.SPHERE_LIST)
    return MarkerArray(
        markers=[
            Marker(action=Marker.DELETEALL),
            *(m for m in markers if m.type not in lists or m.points),
        ]
    )


def _marker(header: Header, namespace: str, kind: int, size_m: float, colour: str) -> Marker:
    marker = Marker(
        header=header, ns=namespace, type=kind, action=Marker.ADD, color=_colour(colour)
    )
    marker.scale.x = marker.scale.y = marker.scale.z = size_m
    marker.pose.orientation.w = 1.0
    return marker


def _text(header: Header, namespace: str, number: int, words: str) -> Marker:
    marker = _marker(header, namespace, Marker.TEXT_VIEW_FACING, _TEXT.size_m, _TEXT_COLOUR)
    marker.id = number
    marker.text = words
    return marker


def _point(x: float, y: float, z: float) -> Point:
    return Point(x=x, y=y, z=z)


def _colour(web: str) -> ColorRGBA:
    """Message of a web colour, #rrggbb."""
    r, g, b = bytes.fromhex(web[1:])
    return ColorRGBA(r=r / 255.0, g=g / 255.0, b=b / 255.0, a=1.0)


main = node_main.program(MarkersNode)

if __name__ == '__main__':
    main()
