"""Topological maps as files: GeoJSON for Nav2's route server, GraphML, tmap2.

GeoJSON: nodes are points, edges are lines along their cells (the route server itself drives
straight from node to node). Its edges are directed, so each edge is written in both directions, the
second as a straight line: the first one has the path. A line of the text is a feature. Ids are
unsigned and unique over nodes and edges. Metadata are flat and without nulls, because the reader
throws on them. `class`, by which the route server's SemanticScorer weighs, is end, branch or corner
of a node, and dead_end (to an end node) or passage of an edge. Lengths and clearances are in m
everywhere. Rooms, corridors and halls are polygons, which the route server skips; with them, a node
has its `region`, and an edge its `region`, `region_kind` and, where it passes one, `door` and
`width_m`. Narrow edges can have a `speed_limit` in per cent; then all others have one of 100, as
the DistanceScorer divides lengths by it.
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from thinmap_ros.core.errors import InputError, require_type
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import MAX_ID, Edge, Node, NodeKind, TopologicalMap
from thinmap_ros.core.topology.regions import Membership, Region
from thinmap_ros.files.safe import atomic_write, path_of, write_text

Writer = Callable[[Path, TopologicalMap, Membership | None], None]
_JSON = json.JSONEncoder(allow_nan=False, separators=(',', ':'))
_REGION = 'Polygon'  # type of the geometry of regions
_GRAPHML_KEYS = {
    'node': ('x', 'y', 'kind', 'clearance', 'region'),
    'edge': ('length', 'clearance', 'path', 'region', 'region_kind', 'door', 'width_m'),
}
_GRAPHML_TYPES = {
    'kind': 'string',
    'path': 'string',
    'region': 'int',
    'region_kind': 'string',
    'door': 'boolean',
}
_ARRIVED_M = 0.3  # distance at which topological_navigation counts a node as reached
_UPRIGHT = {'w': 1.0, 'x': 0.0, 'y': 0.0, 'z': 0.0}
_SIDES = 8  # of the polygon around a node in which the robot counts as arrived


@dataclass(frozen=True)
class SpeedLimit:
    """Per cent of the largest speed on edges with less free width than width_m.

    Raises InputError if a value makes no sense.
    """

    width_m: float
    percent: float

    def __post_init__(self) -> None:
        if not 0.0 < self.width_m < math.inf:
            raise InputError(f'speed limit below {self.width_m} m: expected a width above 0 m')
        if not 0.0 < self.percent <= 100.0:
            raise InputError(f'speed limit of {self.percent} %: expected above 0, at most 100')

    def of(self, edge: Edge) -> float:
        """The limit on an edge, per cent."""
        return self.percent if 2.0 * edge.clearance_m < self.width_m else 100.0


def write_graph(
    path: Path | str,
    topology: TopologicalMap,
    regions: Membership | None = None,
    speed_limit: SpeedLimit | None = None,
) -> None:
    """Write a topological map atomically, in the format given by the file name extension.

    regions: written too, in GeoJSON and GraphML; speed_limit: in GeoJSON alone.
    Raises InputError if the extension is unknown, or the format cannot hold the map.
    """
    path = path_of(path)
    require_type('topology', topology, TopologicalMap)
    writer = writer_of(path)
    if speed_limit is None:
        writer(path, topology, regions)
    elif writer is write_geojson:
        write_geojson(path, topology, regions, speed_limit=speed_limit)
    else:
        raise InputError(f'{path}: a speed limit: expected a name that ends in .geojson')


def writer_of(path: Path) -> Writer:
    """Writer of the format given by a file name extension.

    Raises InputError if the extension is unknown.
    """
    for ending, writer in _WRITERS.items():
        if path.name.endswith(ending) and path.name != ending:
            return writer
    raise InputError(f'{path}: expected a name that ends in {", ".join(_WRITERS)}')


def write_geojson(
    path: Path,
    topology: TopologicalMap,
    regions: Membership | None = None,
    frame_id: str = 'map',
    *,
    with_paths: bool = True,
    speed_limit: SpeedLimit | None = None,
) -> None:
    """Write a topological map atomically.

    The reverse direction of an edge gets an id above all others, and no path. with_paths: False for
    straight edges, as the route server reads no more of them: written in a tenth of the time.

    Raises InputError if an id is too large for an unsigned int.
    """
    highest = max([0, *topology.nodes, *topology.edges])
    if highest + max([0, *topology.edges]) > MAX_ID:
        raise InputError(f'{path}: id {highest}: expected ids whose sum stays below {MAX_ID}')
    with atomic_write(path) as aside, aside.open('w', encoding='utf-8') as file:
        file.write(f'{{"type":"FeatureCollection","name":{json.dumps(path.stem)},"features":[')
        separator = '\n'
        metadata = {e.id: _edge_metadata(topology, e, regions) for e in topology.edges.values()}
        if speed_limit is not None:
            for edge in topology.edges.values():
                metadata[edge.id]['speed_limit'] = speed_limit.of(edge)
        for feature in _features(topology, regions, frame_id, metadata, with_paths):
            file.write(separator + _JSON.encode(feature))
            separator = ',\n'
        file.write('\n]}\n')


def _features(
    topology: TopologicalMap,
    regions: Membership | None,
    frame_id: str,
    metadata: dict[int, dict[str, Any]],
    with_paths: bool,
) -> Iterator[dict[str, Any]]:
    """Nodes, edges in both directions, and regions; one at a time, as there may be many."""
    highest = max([0, *topology.nodes, *topology.edges])
    for node in topology.nodes.values():
        yield _node_feature(node, frame_id, regions)
    for edge in topology.edges.values():
        ends = edge.path[[0, -1]]
        line = edge.path if with_paths else ends
        yield _edge_feature(edge, line, edge.id, edge.a, metadata[edge.id])
        yield _edge_feature(edge, ends[::-1], highest + edge.id, edge.b, metadata[edge.id])
    if regions is not None:
        neighbours = regions.regions.all_neighbours()
        for region in regions.regions.regions.values():
            yield _region_feature(region, neighbours.get(region.id, []))


def write_graphml(path: Path, topology: TopologicalMap, regions: Membership | None = None) -> None:
    """Write an undirected GraphML graph.

    Nodes have x, y, kind and clearance; edges have length, clearance and path. A path is a list of
    points in one string: "x y x y ...". With regions, both have region, and edges that pass one
    have door and width_m.
    """
    root = ElementTree.Element('graphml', xmlns='http://graphml.graphdrawing.org/xmlns')
    for owner, names in _GRAPHML_KEYS.items():
        for name in names:
            attributes = {
                'id': f'{owner}_{name}',
                'for': owner,
                'attr.name': name,
                'attr.type': _GRAPHML_TYPES.get(name, 'double'),
            }
            ElementTree.SubElement(root, 'key', attributes)
    graph = ElementTree.SubElement(root, 'graph', id='topology', edgedefault='undirected')
    for node in topology.nodes.values():
        at = ElementTree.SubElement(graph, 'node', id=str(node.id))
        x, y = _rounded(node.position[None])[0]
        _put_data(
            at,
            'node',
            {
                'x': x,
                'y': y,
                'kind': node.kind.name.lower(),
                'clearance': round(node.clearance_m, 3),
                **_node_region(node, regions),
            },
        )
    for edge in topology.edges.values():
        ends = {'id': str(edge.id), 'source': str(edge.a), 'target': str(edge.b)}
        at = ElementTree.SubElement(graph, 'edge', ends)
        path_text = ' '.join(f'{x} {y}' for x, y in _rounded(edge.path))
        values = {
            'length': round(edge.length_m, 3),
            'clearance': round(edge.clearance_m, 3),
            'path': path_text,
            **_edge_region(edge, regions),
        }
        _put_data(at, 'edge', values)
    ElementTree.indent(root)
    write_text(path, ElementTree.tostring(root, encoding='unicode', xml_declaration=True) + '\n')


def _put_data(element: ElementTree.Element, owner: str, values: dict[str, Any]) -> None:
    for name, value in values.items():
        ElementTree.SubElement(element, 'data', key=f'{owner}_{name}').text = _text(value)


def _text(value: Any) -> str:
    """A value as XML Schema writes it."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def write_tmap2(
    path: Path,
    topology: TopologicalMap,
    regions: Membership | None = None,
    frame_id: str = 'map',
) -> None:
    """Write a map for topological_navigation (LCAS), which has no regions.

    Waypoints are named NODE<id>; edges lead in both directions, with Nav2 as action. A robot is at
    a node within the clearance of the node.
    """
    name = path.name.split('.')[0]
    edges: dict[int, list[dict[str, Any]]] = {node: [] for node in topology.nodes}
    copies: Counter[tuple[int, int]] = Counter()
    for edge in topology.edges.values():
        for start in dict.fromkeys((edge.a, edge.b)):
            end = edge.other(start)
            copies[start, end] += 1
            edges[start].append(_tmap2_edge(edge, start, end, copies[start, end]))
    content = {
        'meta': {'last_updated': datetime.now(UTC).strftime('%Y-%m-%d_%H-%M-%S')},
        'metric_map': name,
        'name': name,
        'pointset': name,
        'transformation': {
            'child': 'topo_map',
            'parent': frame_id,
            'rotation': _UPRIGHT,
            'translation': {'x': 0.0, 'y': 0.0, 'z': 0.0},
        },
        'nodes': [
            _tmap2_node(node, edges[node.id], name, frame_id) for node in topology.nodes.values()
        ],
    }
    write_text(path, yaml.dump(content, Dumper=_WithoutAliases, sort_keys=False))


class _WithoutAliases(yaml.SafeDumper):
    """Writes repeated objects in full, without YAML aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _tmap2_edge(edge: Edge, start: int, end: int, copy: int) -> dict[str, Any]:
    return {
        'edge_id': f'NODE{start}_NODE{end}' + (f'_{copy}' if copy > 1 else ''),
        'node': f'NODE{end}',
        'action': 'navigate_to_pose',
        'action_type': 'geometry_msgs/PoseStamped',
        'goal': {
            'target_pose': {'header': {'frame_id': '$node.parent_frame'}, 'pose': '$node.pose'}
        },
        'config': [],
        'fail_policy': 'fail',
        'fluid_navigation': True,
        'recovery_behaviours_config': '',
        'restrictions_planning': 'True',
        'restrictions_runtime': 'True',
        'properties': {'length': round(edge.length_m, 3), 'clearance': round(edge.clearance_m, 3)},
    }


def _tmap2_node(
    node: Node, edges: list[dict[str, Any]], name: str, frame_id: str
) -> dict[str, Any]:
    x, y = _rounded(node.position[None])[0]
    angles = 2.0 * math.pi * (np.arange(_SIDES) + 0.5) / _SIDES
    corners = node.clearance_m * np.column_stack([np.cos(angles), np.sin(angles)])
    return {
        'meta': {'map': name, 'node': f'NODE{node.id}', 'pointset': name},
        'node': {
            'name': f'NODE{node.id}',
            'parent_frame': frame_id,
            'pose': {'position': {'x': x, 'y': y, 'z': 0.0}, 'orientation': _UPRIGHT},
            'localise_by_topic': '',
            'properties': {
                'xy_goal_tolerance': _ARRIVED_M,
                'yaw_goal_tolerance': round(2.0 * math.pi, 4),
                'kind': node.kind.name.lower(),
                'clearance': round(node.clearance_m, 3),
            },
            'restrictions_planning': 'True',
            'restrictions_runtime': 'True',
            'verts': [{'x': x, 'y': y} for x, y in _rounded(corners)],
            'edges': edges,
        },
    }


def _node_feature(node: Node, frame_id: str, regions: Membership | None) -> dict[str, Any]:
    metadata = {'class': node.kind.name.lower(), 'clearance': round(float(node.clearance_m), 3)}
    metadata |= _node_region(node, regions)
    return {
        'type': 'Feature',
        'properties': {'id': int(node.id), 'frame': frame_id, 'metadata': metadata},
        'geometry': {'type': 'Point', 'coordinates': _rounded(node.position[None])[0]},
    }


def _edge_feature(
    edge: Edge, line: Array, feature_id: int, start: int, metadata: dict[str, Any]
) -> dict[str, Any]:
    return {
        'type': 'Feature',
        'properties': {
            'id': int(feature_id),
            'startid': int(start),
            'endid': int(edge.other(start)),
            'metadata': metadata,
        },
        'geometry': {'type': 'MultiLineString', 'coordinates': [_rounded(line)]},
    }


def _edge_metadata(
    topology: TopologicalMap, edge: Edge, regions: Membership | None
) -> dict[str, Any]:
    kinds = (topology.nodes[edge.a].kind, topology.nodes[edge.b].kind)
    return {
        'class': 'dead_end' if NodeKind.END in kinds else 'passage',
        'edge': int(edge.id),
        'length': round(float(edge.length_m), 3),
        'clearance': round(float(edge.clearance_m), 3),
        **_edge_region(edge, regions),
    }


def _region_feature(region: Region, neighbours: list[int]) -> dict[str, Any]:
    properties = {
        'id': region.id,
        'kind': region.kind.name.lower(),
        'area_m2': round(region.area_m2, 2),
        'neighbours': neighbours,
    }
    if region.name:
        properties['name'] = region.name
    ring = _rounded(np.concatenate([region.outline, region.outline[:1]]))
    geometry = {'type': _REGION, 'coordinates': [ring]}
    return {'type': 'Feature', 'properties': properties, 'geometry': geometry}


def _node_region(node: Node, regions: Membership | None) -> dict[str, Any]:
    if regions is None or node.id not in regions.of_node:
        return {}
    return {'region': regions.of_node[node.id]}


def _edge_region(edge: Edge, regions: Membership | None) -> dict[str, Any]:
    if regions is None or edge.id not in regions.of_edge:
        return {}
    region = regions.of_edge[edge.id]
    found: dict[str, Any] = {'region': region}
    found['region_kind'] = regions.regions.regions[region].kind.name.lower()
    door = regions.door_of.get(edge.id)
    if door is not None:
        found |= {'door': True, 'width_m': round(door.width_m, 2)}
    return found


def _rounded(points: Array) -> list[list[float]]:
    """Points (N, 2), rounded to a tenth of a millimetre."""
    return [[round(x, 4), round(y, 4)] for x, y in points.tolist()]


_WRITERS: dict[str, Writer] = {
    '.geojson': write_geojson,
    '.graphml': write_graphml,
    '.tmap2.yaml': write_tmap2,
    '.tmap2': write_tmap2,
}
