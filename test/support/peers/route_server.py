"""A substitute for Nav2's route server: it loads graphs by the rules of Jazzy's GeoJSON loader.

Node: Point with properties.id (unsigned), optional frame, coordinates [x, y]. Edge: LineString or
MultiLineString with properties id, startid, endid of nodes that exist. Metadata: numbers, booleans,
strings, arrays and objects of these; null is an error. A graph without nodes or edges is refused.
"""

import json
from dataclasses import dataclass
from pathlib import Path

from nav2_msgs.srv import SetRouteGraph


@dataclass(frozen=True)
class RouteGraph:
    """Nodes: id -> (x, y, frame, metadata); edges: id -> (start, end, metadata)."""

    nodes: dict
    edges: dict


def load(path):
    """Route graph of a file. Raises ValueError where the loader refuses it."""
    if not Path(path).exists():
        raise ValueError(f'{path} does not exist')
    features = json.loads(Path(path).read_text())['features']
    nodes = {}
    for feature in of_type(features, 'Point'):
        properties = feature['properties']
        x, y = map(float, feature['geometry']['coordinates'][:2])
        frame = properties.get('frame', 'map')
        nodes[unsigned(properties['id'])] = (x, y, frame, metadata(properties))
    edges = {}
    for feature in of_type(features, 'LineString', 'MultiLineString'):
        properties = feature['properties']
        ends = unsigned(properties['startid']), unsigned(properties['endid'])
        if not nodes.keys() >= set(ends):
            raise ValueError(f'edge {properties["id"]}: no node {ends}')
        edges[unsigned(properties['id'])] = (*ends, metadata(properties))
    if not nodes or not edges:
        raise ValueError('the graph is malformed: no nodes or no edges')
    if nodes.keys() & edges.keys():
        raise ValueError('ids of nodes and edges are not unique')
    return RouteGraph(nodes, edges)


def of_type(features, *kinds):
    return [feature for feature in features if feature['geometry']['type'] in kinds]


def unsigned(value):
    if type(value) is not int or not 0 <= value < 2**32:
        raise ValueError(f'{value!r} is no unsigned int')
    return value


def metadata(properties):
    return {key: value_of(value) for key, value in properties.get('metadata', {}).items()}


def value_of(value):
    if isinstance(value, dict):
        return {key: value_of(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [value_of(inner) for inner in value]
    if not isinstance(value, bool | int | float | str):
        raise ValueError(f'{value!r}: no value')
    return value


class RouteServer:
    """Serves route_server/set_route_graph; paths and graphs: those that it loaded, in order."""

    def __init__(self, graph):
        self.paths = []
        self.graphs = []
        self.refuses = False
        self.refused = 0
        self._node = graph.node
        self._service = self._node.create_service(
            SetRouteGraph, 'route_server/set_route_graph', self._set
        )

    def _set(self, request, response):
        response.success = False
        if self.refuses:
            self.refused += 1
            return response
        self.graphs.append(load(request.graph_filepath))
        self.paths.append(Path(request.graph_filepath))
        response.success = True
        return response

    def close(self):
        self._node.destroy_service(self._service)
