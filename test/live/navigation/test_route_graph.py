"""topology_builder gives the growing graph to Nav2's route server."""

import pytest
from geometry_msgs.msg import PoseStamped, Twist
from support.halls import AT_START, START
from support.peers.route_server import RouteServer

from thinmap_msgs.msg import TopologicalMap
from thinmap_msgs.srv import SaveMap
from thinmap_ros.core.topology.graph import NodeKind, topology_from_msg
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


def is_of(route_graph, topology):
    """Whether a route graph has the nodes of a published graph, as they are."""
    received = {
        number: (x, y, metadata['clearance'])
        for number, (x, y, _, metadata) in route_graph.nodes.items()
    }
    return received == {
        node.id: pytest.approx((node.x, node.y, node.clearance_m), abs=1e-3)
        for node in topology_from_msg(topology).nodes.values()
    }


def test_a_route_server_receives_the_graph_as_it_grows_and_when_it_is_saved(graph, tmp_path):
    server = RouteServer(graph)
    mapping = Mapping(graph, route_graph_period_s=1.0)
    mapping.drives_until(
        lambda: len({len(received.nodes) for received in server.graphs}) > 1,
        'a graph that has grown',
    )
    mapping.stands()
    graph.until(lambda: is_of(server.graphs[-1], mapping.graphs[-1]), 'the newest graph')
    topology = topology_from_msg(mapping.graphs[-1])
    received = server.graphs[-1]
    for node in topology.nodes.values():
        _, _, frame, metadata = received.nodes[node.id]
        assert frame == 'map'
        assert metadata == {
            'class': NodeKind(node.kind).name.lower(),
            'clearance': pytest.approx(node.clearance_m, abs=1e-3),
        }
    both_ways = sorted((e.a, e.b) for e in topology.edges.values())
    both_ways += sorted((e.b, e.a) for e in topology.edges.values())
    assert sorted((start, end) for start, end, _ in received.edges.values()) == sorted(both_ways)
    ends = {node.id for node in topology.nodes.values() if node.kind == NodeKind.END}
    for start, end, metadata in received.edges.values():
        assert metadata['class'] == ('dead_end' if ends & {start, end} else 'passage')
        assert metadata['clearance'] > 0.2 and metadata['length'] > 0.0
    assert len(set(server.paths)) == 1
    server.paths[0].unlink()
    assert graph.stop('topology_builder') == 0, graph.log('topology_builder')


def test_one_that_starts_late_or_refuses_receives_the_graph_of_that_time(graph, tmp_path):
    path = tmp_path / 'routes' / 'live.geojson'
    mapping = Mapping(graph, route_graph_period_s=1.0, route_graph_path=str(path))
    graph.until(path.exists, 'a file without a route server')
    mapping.stands()
    server = RouteServer(graph)
    graph.until(lambda: server.graphs, 'a graph for the late one')
    assert server.paths == [path]
    assert is_of(server.graphs[-1], mapping.graphs[-1])
    server.refuses = True
    mapping.drives_until(lambda: server.refused, 'a graph that is refused')
    graph.until(lambda: 'not loaded' in graph.log('topology_builder'), 'a warning')
    server.refuses = False
    mapping.stands()
    graph.until(lambda: is_of(server.graphs[-1], mapping.graphs[-1]), 'the newest graph')


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
        assert is_of(server.graphs[-1], mapping.graphs[-1])
    assert len(server.graphs) == updates
    assert path.exists() == bool(updates)
