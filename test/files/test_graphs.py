"""Route graphs: the format of Nav2's reader, and all of a graph in it."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap
from thinmap_ros.core.topology.regions import (
    Door,
    Membership,
    Region,
    RegionKind,
    RegionMap,
    membership_of,
)
from thinmap_ros.files.graphs import (
    SpeedLimit,
    write_geojson,
    write_graph,
    write_graphml,
    write_tmap2,
)


def edge(edge_id: int, a: int, b: int, *points: tuple[float, float]) -> Edge:
    path = np.array(points)
    return Edge(edge_id, a, b, path, float(np.hypot(*np.diff(path, axis=0).T).sum()), 0.35)


def example() -> TopologicalMap:
    nodes = [
        Node(1, NodeKind.BRANCH, 0.0, 0.0, 1.2),
        Node(3, NodeKind.END, 2.0, 0.0, np.float64(0.4)),  # type: ignore[arg-type]
        Node(7, NodeKind.CORNER, 0.0, 3.123456, 0.5),
    ]
    edges = [
        edge(2, 1, 3, (0.0, 0.0), (1.0, 0.5), (2.0, 0.0)),
        edge(4, 3, 1, (2.0, 0.0), (1.0, -0.5), (0.0, 0.0)),
        edge(9, 1, 7, (0.0, 0.0), (0.0, 3.123456)),
        edge(5, 7, 7, (0.0, 3.123456), (1.0, 4.0), (-1.0, 4.0), (0.0, 3.123456)),
    ]
    return TopologicalMap(nodes, edges)


def written(tmp_path: Path) -> list[dict[str, Any]]:
    write_geojson(tmp_path / 'g.geojson', example(), frame_id='floor')
    content = json.loads((tmp_path / 'g.geojson').read_text())
    assert content['type'] == 'FeatureCollection'
    features: list[dict[str, Any]] = content['features']
    return features


def features_of(path: Path) -> dict[int, dict[str, Any]]:
    return {f['properties']['id']: f for f in json.loads(path.read_text())['features']}


def test_it_is_what_the_route_server_reads(tmp_path: Path) -> None:
    features = written(tmp_path)
    ids = [f['properties']['id'] for f in features]
    assert len(set(ids)) == len(ids) == 3 + 2 * 4
    assert all(isinstance(i, int) and 0 < i < 2**32 for i in ids)
    nodes = {f['properties']['id']: f for f in features if f['geometry']['type'] == 'Point'}
    assert {f['properties']['frame'] for f in nodes.values()} == {'floor'}
    ways = set()
    for f in features:
        assert all(isinstance(v, str | int | float) for v in f['properties']['metadata'].values())
        if f['geometry']['type'] == 'MultiLineString':
            start = f['properties']['startid']
            end = f['properties']['endid']
            (line,) = f['geometry']['coordinates']
            assert line[0] == nodes[start]['geometry']['coordinates']
            assert line[-1] == nodes[end]['geometry']['coordinates']
            ways.add((f['properties']['metadata']['edge'], start, end))
    assert {(2, 1, 3), (2, 3, 1), (4, 3, 1), (4, 1, 3), (9, 1, 7), (9, 7, 1), (5, 7, 7)} == ways
    assert nodes[3]['properties']['metadata'] == {'class': 'end', 'clearance': 0.4}
    classes = {
        f['properties']['metadata']['edge']: f['properties']['metadata']['class']
        for f in features
        if f['geometry']['type'] == 'MultiLineString'
    }
    assert classes == {2: 'dead_end', 4: 'dead_end', 9: 'passage', 5: 'passage'}


def test_a_graph_without_paths_has_the_same_nodes_and_straight_edges(tmp_path: Path) -> None:
    write_geojson(tmp_path / 'g.geojson', example(), with_paths=False)
    found = features_of(tmp_path / 'g.geojson')
    assert example().nodes.keys() < found.keys()
    for number, edge in example().edges.items():
        (line,) = found[number]['geometry']['coordinates']
        np.testing.assert_allclose(line, edge.path[[0, -1]], atol=1e-4)
        length_m = found[number]['properties']['metadata']['length']
        assert length_m == pytest.approx(edge.length_m, abs=1e-3)


def small() -> TopologicalMap:
    nodes = [Node(1, NodeKind.BRANCH, 0.0, 0.5, 1.0), Node(3, NodeKind.END, 2.0, 0.5, 0.4)]
    return TopologicalMap(nodes, [edge(2, 1, 3, (0.0, 0.5), (2.0, 0.5))])


def test_it_is_what_topological_navigation_reads(tmp_path: Path) -> None:
    write_tmap2(tmp_path / 'g.tmap2.yaml', small(), frame_id='floor')
    content = yaml.safe_load((tmp_path / 'g.tmap2.yaml').read_text())
    upright = {'x': 0.0, 'y': 0.0, 'z': 0.0, 'w': 1.0}
    assert content['transformation'] == {
        'child': 'topo_map',
        'parent': 'floor',
        'rotation': upright,
        'translation': {'x': 0.0, 'y': 0.0, 'z': 0.0},
    }
    assert content['metric_map'] == content['name'] == content['pointset'] == 'g'
    first, second = content['nodes']
    assert first['meta'] == {'map': 'g', 'node': 'NODE1', 'pointset': 'g'}
    node = first['node']
    verts = np.array([[vert['x'], vert['y']] for vert in node.pop('verts')])
    np.testing.assert_allclose(np.hypot(*verts.T), 1.0, atol=2e-3)
    np.testing.assert_allclose(verts.mean(axis=0), 0.0, atol=1e-3)
    (only,) = node.pop('edges')
    assert node == {
        'name': 'NODE1',
        'parent_frame': 'floor',
        'pose': {'position': {'x': 0.0, 'y': 0.5, 'z': 0.0}, 'orientation': upright},
        'localise_by_topic': '',
        'properties': {
            'xy_goal_tolerance': 0.3,
            'yaw_goal_tolerance': 6.2832,
            'kind': 'branch',
            'clearance': 1.0,
        },
        'restrictions_planning': 'True',
        'restrictions_runtime': 'True',
    }
    assert only == {
        'edge_id': 'NODE1_NODE3',
        'node': 'NODE3',
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
        'properties': {'length': 2.0, 'clearance': 0.35},
    }
    assert [back['node'] for back in second['node']['edges']] == ['NODE1']


def test_graphml_holds_positions_kinds_and_paths(tmp_path: Path) -> None:
    write_graphml(tmp_path / 'g.graphml', small())
    text = (tmp_path / 'g.graphml').read_text()
    assert '<data key="node_y">0.5</data>' in text
    assert '<data key="node_kind">end</data>' in text
    assert '<data key="edge_length">2.0</data>' in text
    assert '<data key="edge_clearance">0.35</data>' in text
    assert '<data key="edge_path">0.0 0.5 2.0 0.5</data>' in text


def test_nodes_and_edges_are_written_as_they_are(tmp_path: Path) -> None:
    written(tmp_path)
    found = features_of(tmp_path / 'g.geojson')
    before = example()
    for i, node in before.nodes.items():
        metadata = found[i]['properties']['metadata']
        assert metadata['class'] == node.kind.name.lower()
        assert metadata['clearance'] == pytest.approx(node.clearance_m, abs=1e-3)
        assert found[i]['geometry']['coordinates'] == pytest.approx(node.position, abs=1e-4)
    for i, one in before.edges.items():
        properties = found[i]['properties']
        assert (properties['startid'], properties['endid']) == (one.a, one.b)
        (line,) = found[i]['geometry']['coordinates']
        np.testing.assert_allclose(line, one.path, atol=1e-4)
        assert properties['metadata']['length'] == pytest.approx(one.length_m, abs=1e-3)


def test_not_a_number_is_never_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match='JSON'):
        write_geojson(
            tmp_path / 'g.geojson', TopologicalMap([Node(1, NodeKind.END, np.nan, 0.0, 1.0)])
        )
    assert list(tmp_path.iterdir()) == []


def region(number: int, kind: RegionKind, x: float) -> Region:
    outline = np.array([(x, -1.0), (x + 1.0, -1.0), (x + 1.0, 4.0), (x, 4.0)])
    return Region(number, kind, x + 0.5, 1.0, 5.0, outline)


def with_regions() -> Membership:
    """A corridor on the left of x = 1 m, a room on the right, and a door between them."""
    labels = np.repeat([[4, 8, 8]], 5, axis=0).astype(np.int32)
    door = Door(4, 8, 1.0, 0.5, 0.9)
    regions = {4: region(4, RegionKind.CORRIDOR, 0.0), 8: region(8, RegionKind.ROOM, 1.0)}
    found = RegionMap(GridFrame(0.0, -1.0, 1.0), labels, regions, (door,))
    return membership_of(small(), found)


def test_geojson_holds_regions(tmp_path: Path) -> None:
    path = tmp_path / 'g.geojson'
    write_graph(path, small(), with_regions())
    features = json.loads(path.read_text())['features']
    polygons = [f for f in features if f['geometry']['type'] == 'Polygon']
    assert [f['properties'] for f in polygons] == [
        {'id': 4, 'kind': 'corridor', 'area_m2': 5.0, 'neighbours': [8]},
        {'id': 8, 'kind': 'room', 'area_m2': 5.0, 'neighbours': [4]},
    ]
    (ring,) = polygons[0]['geometry']['coordinates']
    assert ring == [[0.0, -1.0], [1.0, -1.0], [1.0, 4.0], [0.0, 4.0], [0.0, -1.0]]
    metadata = {
        f['properties']['id']: f['properties']['metadata'] for f in features if f not in polygons
    }
    assert (metadata[1]['region'], metadata[3]['region']) == (4, 8)
    for number in (2, 5):  # both directions of the edge
        assert (metadata[number]['region'], metadata[number]['region_kind']) in (
            (4, 'corridor'),
            (8, 'room'),
        )
        assert (metadata[number]['door'], metadata[number]['width_m']) == (True, 0.9)
    assert metadata.keys() == {1, 3, 2, 5}


def test_graphml_holds_the_regions_of_nodes_and_edges(tmp_path: Path) -> None:
    path = tmp_path / 'g.graphml'
    write_graph(path, small(), with_regions())
    text = path.read_text()
    for line in (
        '<data key="node_region">4</data>',
        '<data key="node_region">8</data>',
        '<data key="edge_region_kind">corridor</data>',
        '<data key="edge_door">true</data>',
        '<data key="edge_width_m">0.9</data>',
    ):
        assert line in text
    write_graph(path, small())
    assert '<data key="node_region">' not in path.read_text()


def test_narrow_edges_have_a_speed_limit_and_all_others_the_full_speed(tmp_path: Path) -> None:
    path = tmp_path / 'g.geojson'
    nodes = [Node(i, NodeKind.CORNER, float(i), 0.0, 1.0) for i in (1, 2, 3)]
    narrow, wide = (edge(i + 3, i, i + 1, (i, 0.0), (i + 1.0, 0.0)) for i in (1, 2))
    graph = TopologicalMap(nodes, [narrow, replace(wide, clearance_m=0.6)])
    write_graph(path, graph, speed_limit=SpeedLimit(1.0, 40.0))
    features = json.loads(path.read_text())['features']
    metadata = [f['properties']['metadata'] for f in features if 'startid' in f['properties']]
    assert [(m['edge'], m['speed_limit']) for m in metadata] == [
        (4, 40.0),
        (4, 40.0),
        (5, 100.0),
        (5, 100.0),
    ]
    with pytest.raises(InputError, match='geojson'):
        write_graph(tmp_path / 'g.graphml', graph, speed_limit=SpeedLimit(1.0, 40.0))


@pytest.mark.parametrize('values', [(0.0, 50.0), (1.0, 0.0), (1.0, 101.0), (math.nan, 50.0)])
def test_a_speed_limit_that_makes_no_sense_is_refused(values: tuple[float, float]) -> None:
    with pytest.raises(InputError, match='speed limit'):
        SpeedLimit(*values)


def test_a_path_is_written_once_and_a_feature_is_a_line(tmp_path: Path) -> None:
    path = tmp_path / 'g.geojson'
    features = written(tmp_path)
    by_id = {f['properties']['id']: f for f in features}
    for own, reverse in ((2, 11), (5, 14)):
        line = example().edges[own].path.round(4)
        assert by_id[own]['geometry']['coordinates'] == [line.tolist()]
        assert by_id[reverse]['geometry']['coordinates'] == [line[[-1, 0]].tolist()]
    first, *lines, last = path.read_text().splitlines()
    assert first.endswith('"features":[') and last == ']}'
    assert [json.loads(line.removesuffix(',')) for line in lines] == features


def test_an_empty_graph_is_a_collection(tmp_path: Path) -> None:
    write_geojson(tmp_path / 'g.geojson', TopologicalMap())
    assert json.loads((tmp_path / 'g.geojson').read_text())['features'] == []
