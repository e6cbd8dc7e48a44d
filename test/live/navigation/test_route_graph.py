"""topology_builder gives the route graph of the growing map to Nav2's route server."""

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, Twist
from support.halls import AT_START, START
from support.peers.route_server import RouteServer, load

from thinmap_msgs.msg import TopologicalMap
from thinmap_msgs.srv import AddKeepOut, RemoveKeepOut, SaveMap
from thinmap_ros.core.grid.edits import KeepOut, KeepOutArea, inside
from thinmap_ros.core.topology.graph import TopologyConfig, topology_from_msg
from thinmap_ros.core.topology.topology import build_routes, unpack
from thinmap_ros.files.graphs import write_geojson
from thinmap_ros.files.sessions import load_topology
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live


class Mapping:
    """A simulated robot that maps, and the graphs that are published."""

    def __init__(self, graph, **parameters):
        self.graph = graph
        self.graphs = graph.heard('topology', TopologicalMap, qos.LATCHED)
        self._truth = graph.heard('ground_truth', PoseStamped)
        self._commands = graph.node.create_publisher(Twist, 'cmd_vel', 10)
        graph.start('localizer', use_sim_time=True, **AT_START)
        graph.start('grid_mapper', use_sim_time=True)
        graph.start('topology_builder', use_sim_time=True, **parameters)
        graph.start(
            'sim',
            remap=graph.paced(),
            start=START,
            wait_for_subscribers=1,
            real_time_factor=4.0,
            lockstep='local_topology',
        )
        graph.until(lambda: self.graphs and self.graphs[-1].edge_ids, 'a graph with edges')

    def drives_until(self, condition, what):
        """Drive in a circle until a condition holds."""

        def is_met():
            self._commands.publish(messages.twist_msg(0.3, 0.25))
            return condition()

        self.graph.until(is_met, what)

    def stands(self):
        """Stop, and wait until the graph does not change any more."""

        def is_still():
            self._commands.publish(messages.twist_msg(0.0, 0.0))
            self._truth.clear()
            self.graphs[:-1] = []
            self.graph.until(lambda: len(self._truth) > 30, 'time')
            return len(self.graphs) == 1

        self.graph.until(is_still, 'a graph that does not change')

    def routes(self, *areas):
        """The route graph by the rules of map_to_graph, with some areas (4, 2) as walls."""
        session = str(self.graph.folder / 'maps' / 'now')
        request = SaveMap.Request(path=session, overwrite=True)
        assert self.graph.call(SaveMap, 'save_topology', request).success
        saved = unpack(load_topology(session, TopologyConfig()).state())
        keep_out = KeepOut([KeepOutArea(i, area) for i, area in enumerate(areas, 1)])
        patch = keep_out.as_walls(saved.patch)
        starts = saved.frame.centres_of(saved.robot_places)
        path = self.graph.folder / 'expected.geojson'
        routes = build_routes(patch, starts, TopologyConfig(max_unknown_gap_m=0.0))
        write_geojson(path, routes.map)
        return load(path)


def is_same(route_graph, other):
    """Whether two route graphs have the same places and ways, whatever their ids."""
    return _nodes_and_edges(route_graph) == _nodes_and_edges(other)


def _nodes_and_edges(route_graph):
    places = {number: (x, y) for number, (x, y, _, _) in route_graph.nodes.items()}
    ways = [
        (places[start], places[end], metadata['class'], metadata['length'], metadata['clearance'])
        for start, end, metadata in route_graph.edges.values()
    ]
    return sorted(places.values()), sorted(ways)


def crosses(route_graph, area):
    """Whether a straight edge of a route graph leads through an area."""
    places = {number: (x, y) for number, (x, y, _, _) in route_graph.nodes.items()}
    ways = [
        np.linspace(places[start], places[end], 200) for start, end, _ in route_graph.edges.values()
    ]
    return inside(np.concatenate(ways), area).any()


def test_a_route_server_receives_the_graph_of_map_to_graph_as_the_map_grows(graph):
    server = RouteServer(graph)
    mapping = Mapping(graph, route_graph_period_s=1.0)
    mapping.drives_until(
        lambda: len({len(received.nodes) for received in server.graphs}) > 1,
        'a graph that has grown',
    )
    mapping.stands()
    expected = mapping.routes()
    graph.until(lambda: is_same(server.graphs[-1], expected), 'the graph of the map')
    received = server.graphs[-1]
    assert {frame for _, _, frame, _ in received.nodes.values()} == {'map'}
    ids = {node.id for node in topology_from_msg(mapping.graphs[-1]).nodes.values()}
    assert ids & received.nodes.keys()  # places that are nodes of both have one id
    assert len(set(server.paths)) == 1
    server.paths[0].unlink()
    assert graph.stop('topology_builder') == 0, graph.log('topology_builder')


def test_edges_through_a_keep_out_area_are_gone_at_once_and_come_back(graph):
    server = RouteServer(graph)
    # Nothing but an area leads to an update.
    mapping = Mapping(graph, route_graph_period_s=3600.0)
    mapping.stands()
    assert graph.call(SaveMap, 'save_topology', SaveMap.Request(path='maps/room')).success
    graph.until(lambda: server.graphs, 'a graph')
    before = server.graphs[-1]
    start, end, _ = max(before.edges.values(), key=lambda edge: edge[2]['length'])
    x, y = np.mean([before.nodes[i][:2] for i in (start, end)], axis=0)
    area = np.array([(x, y)] * 4) + 0.2 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    area = area.astype(np.float32).astype(np.float64)  # as in the message
    assert crosses(before, area)
    count = len(server.graphs)

    request = AddKeepOut.Request(corners=messages.polygon_msg(area))
    assert graph.call(AddKeepOut, 'add_keep_out', request).success
    graph.until(lambda: not crosses(server.graphs[-1], area), 'a graph round the area')
    assert len(server.graphs) == count + 1
    kept = {n: place[:2] for n, place in server.graphs[-1].nodes.items() if n in before.nodes}
    assert kept
    for number, place in kept.items():
        assert np.hypot(*np.subtract(place, before.nodes[number][:2])) <= 0.5
    expected = mapping.routes(area)
    graph.until(lambda: is_same(server.graphs[-1], expected), 'the graph with walls')

    assert graph.call(RemoveKeepOut, 'remove_keep_out', RemoveKeepOut.Request(id=1)).success
    graph.until(lambda: crosses(server.graphs[-1], area), 'a graph through the area')
    expected = mapping.routes()
    graph.until(lambda: is_same(server.graphs[-1], expected), 'the graph without areas')


def test_one_that_starts_late_or_refuses_receives_the_graph_of_that_time(graph, tmp_path):
    path = tmp_path / 'routes' / 'live.geojson'
    mapping = Mapping(graph, route_graph_period_s=1.0, route_graph_path=str(path))
    graph.until(path.exists, 'a file without a route server')
    mapping.stands()
    server = RouteServer(graph)
    graph.until(lambda: server.graphs, 'a graph for the late one')
    assert server.paths == [path]
    expected = mapping.routes()
    graph.until(lambda: is_same(server.graphs[-1], expected), 'the newest graph')
    server.refuses = True
    mapping.drives_until(lambda: server.refused, 'a graph that is refused')
    graph.until(lambda: 'not loaded' in graph.log('topology_builder'), 'a warning')
    server.refuses = False
    count = len(server.graphs)
    mapping.stands()
    graph.until(lambda: len(server.graphs) > count, 'a graph after the refused one')
    expected = mapping.routes()
    graph.until(lambda: is_same(server.graphs[-1], expected), 'the newest graph')


@pytest.mark.parametrize(('period_s', 'updates'), [(0.0, 0), (3600.0, 1)])
def test_growth_leads_to_one_update_a_period_and_a_save_to_one_at_once(graph, period_s, updates):
    """0 switches all of it off."""
    server = RouteServer(graph)
    path = graph.folder / 'live.geojson'
    mapping = Mapping(graph, route_graph_period_s=period_s, route_graph_path=str(path))
    count = len(mapping.graphs)
    mapping.drives_until(lambda: len(mapping.graphs) > count + 5, 'a graph that grows')
    assert not server.graphs
    assert not path.exists()
    mapping.stands()
    assert graph.call(SaveMap, 'save_topology', SaveMap.Request(path='maps/room')).success
    if updates:
        graph.until(lambda: server.graphs, 'the graph at once')
    assert len(server.graphs) == updates
    assert path.exists() == bool(updates)
    if updates:
        expected = mapping.routes()
        graph.until(lambda: is_same(server.graphs[-1], expected), 'the newest graph')
