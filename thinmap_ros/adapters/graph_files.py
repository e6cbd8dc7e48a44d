"""Topological maps as route graphs in GeoJSON, which Nav2's route server loads.

Nodes are points, edges are lines along the cells that they were found in (the route server itself drives straight from
node to node). Edges are directed there, so each of ours is written in both directions; ids are unsigned and unique over
nodes and edges; metadata are flat and without nulls, on which its reader would throw.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.adapters.files import read_text, write_text
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap

_LARGEST_ID = 2**32 - 1


def write_geojson(path: Path, topology: TopologicalMap, frame_id: str = 'map') -> None:
    """Write a topological map, whole or not at all; the way back along an edge has an id above all others.

    Raises InputError where an id is too large for an unsigned int.
    """
    highest = max([0, *topology.nodes, *topology.edges])
    if highest + max([0, *topology.edges]) > _LARGEST_ID:
        raise InputError(f'{path}: id {highest}: expected ids whose sum stays below {_LARGEST_ID}')
    features = [_node_feature(node, frame_id) for node in topology.nodes.values()]
    for edge in topology.edges.values():
        features.append(_edge_feature(edge, edge.id, edge.a))
        features.append(_edge_feature(edge, highest + edge.id, edge.b))
    collection = {'type': 'FeatureCollection', 'name': path.stem, 'features': features}
    write_text(path, json.dumps(collection, indent=1, allow_nan=False) + '\n')


def read_geojson(path: Path) -> TopologicalMap:
    """Read a topological map that `write_geojson` wrote. Raises InputError naming the file and the feature."""
    try:
        features = json.loads(read_text(path))['features']
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f'{path}: {error}: expected a GeoJSON collection of features') from error
    topology = TopologicalMap()
    lines: list[tuple[int, dict[str, Any]]] = []
    for i, feature in enumerate(features if isinstance(features, list) else []):
        try:
            if feature['geometry']['type'] == 'Point':
                topology.put_node(_node(feature))
            else:
                lines.append((i, feature))
        except (KeyError, TypeError, ValueError, InputError) as error:
            raise InputError(f'{path}: features[{i}]: {error}: expected a node (point with id, kind)') from error
    for i, feature in lines:
        try:
            if feature['properties']['id'] == feature['properties']['metadata']['edge']:
                topology.put_edge(_edge(feature))
        except (KeyError, TypeError, ValueError, InputError) as error:
            raise InputError(f'{path}: features[{i}]: {error}: expected an edge (line with ids, length_m)') from error
    return topology


def _node_feature(node: Node, frame_id: str) -> dict[str, Any]:
    metadata = {'kind': node.kind.name.lower(), 'clearance_m': round(float(node.clearance_m), 3)}
    return {
        'type': 'Feature',
        'properties': {'id': int(node.id), 'frame': frame_id, 'metadata': metadata},
        'geometry': {'type': 'Point', 'coordinates': _rounded(node.position[None])[0]},
    }


def _edge_feature(edge: Edge, feature_id: int, start: int) -> dict[str, Any]:
    metadata = {
        'edge': int(edge.id),
        'length_m': round(float(edge.length_m), 3),
        'clearance_m': round(float(edge.clearance_m), 3),
    }
    # A loop begins and ends at one node: its way back is told by its id.
    path = edge.path if feature_id == edge.id else edge.path[::-1]
    return {
        'type': 'Feature',
        'properties': {
            'id': int(feature_id),
            'startid': int(start),
            'endid': int(edge.other(start)),
            'metadata': metadata,
        },
        'geometry': {'type': 'MultiLineString', 'coordinates': [_rounded(path)]},
    }


def _rounded(points: Array) -> list[list[float]]:
    """Points (N, 2) to a tenth of a millimetre."""
    return [[round(float(x), 4), round(float(y), 4)] for x, y in points]


def _finite(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f'{value!r} is no finite number')
    return float(value)


def _id(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f'id {value!r} is no whole number')
    return value


def _node(feature: dict[str, Any]) -> Node:
    properties, (x, y) = feature['properties'], feature['geometry']['coordinates']
    metadata = properties['metadata']
    kind = NodeKind[str(metadata['kind']).upper()]
    return Node(_id(properties['id']), kind, _finite(x), _finite(y), _finite(metadata['clearance_m']))


def _edge(feature: dict[str, Any]) -> Edge:
    properties, (line,) = feature['properties'], feature['geometry']['coordinates']
    path = np.array([[_finite(x), _finite(y)] for x, y in line])
    if len(path) < 2:
        raise ValueError(f'a line of {len(path)} points')
    metadata = properties['metadata']
    ends = (_id(properties['startid']), _id(properties['endid']))
    return Edge(_id(properties['id']), *ends, path, _finite(metadata['length_m']), _finite(metadata['clearance_m']))
