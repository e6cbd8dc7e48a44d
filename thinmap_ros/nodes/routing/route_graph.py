"""The topological map as route graph of Nav2's route server, updated while it grows."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nav2_msgs.srv import SetRouteGraph
from rclpy.client import Client
from rclpy.task import Future

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.files.graphs import write_geojson
from thinmap_ros.jit.cache import private_folder, temporary_folder
from thinmap_ros.ros import parameters
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import WARN_PERIOD_S
from thinmap_ros.ros.time_jumps import STEADY

_SERVICE = 'route_server/set_route_graph'


@dataclass(frozen=True)
class RouteGraphConfig(Config):
    """When and where the graph is written for a route server."""

    route_graph_period_s: float = parameter(
        5.0,
        "Least time between two updates of Nav2's route server with the graph as it grows (s). "
        'Raise it for buildings with thousands of nodes, lower it if routes are asked for while '
        'the map grows. 0: the graph is not written and the route server not called.',
        low=0.0,
        high=3600.0,
    )
    route_graph_path: str = parameter(
        '',
        'GeoJSON file that the route server is asked to load; with a name it is written without a '
        'route server, too. Empty: a file of this user among the temporary files, written while '
        'there is a route server. Set it if the route server runs as another user or on another '
        'machine with a shared disk.',
    )


class RouteGraphUpdates:
    """Writes the graph after changes, and has Nav2's route server load it.

    A graph without edges is never sent, as the route server refuses it. A route server that starts
    later, or has refused a graph, receives the one of that time.
    """

    def __init__(
        self, node: ThinmapNode, frame_id: str, topology: Callable[[], TopologicalMap]
    ) -> None:
        """Declare the parameters; topology: returns the present graph, in the frame frame_id."""
        self._node = node
        self._frame_id = frame_id
        self._topology = topology
        self._config = parameters.declare_config(node, RouteGraphConfig)
        self._is_changed = False
        self._client: Client | None = None
        self._was_ready = False
        self._pending: Future | None = None
        if self._config.route_graph_period_s > 0.0:
            self._client = node.create_client(SetRouteGraph, _SERVICE)
            node.create_active_timer(self._config.route_graph_period_s, self._update, clock=STEADY)

    def graph_changed(self) -> None:
        """Update the route server at the end of the period."""
        self._is_changed = True

    def graph_saved(self) -> None:
        """Update the route server at once."""
        self._is_changed = True
        self._update()

    def _update(self) -> None:
        if self._client is None:
            return
        is_ready = self._client.service_is_ready()
        self._is_changed |= is_ready and not self._was_ready
        self._was_ready = is_ready
        if not self._is_changed or not (is_ready or self._config.route_graph_path):
            return
        topology = self._topology()
        if not topology.edges:
            return
        try:
            with self._node.diagnostics.time_step('route graph'):
                path = self._path()
                write_geojson(path, topology, frame_id=self._frame_id, with_paths=False)
        except (InputError, OSError) as error:
            self._warn(f'route graph not written: {one_line_reason(error)}')
            return
        self._is_changed = False
        if is_ready:
            self._send(self._client, path)

    def _path(self) -> Path:
        if self._config.route_graph_path:
            return Path(self._config.route_graph_path).resolve()
        name = self._node.get_fully_qualified_name().strip('/').replace('/', '.')
        file_name = f'{os.environ.get("ROS_DOMAIN_ID", "0")}.{name}.geojson'
        return private_folder(temporary_folder()) / file_name

    def _send(self, client: Client, path: Path) -> None:
        if self._pending is not None:
            client.remove_pending_request(self._pending)
        self._pending = client.call_async(SetRouteGraph.Request(graph_filepath=str(path)))
        self._pending.add_done_callback(lambda done: self._on_answer(done, path))

    def _on_answer(self, done: Future, path: Path) -> None:
        self._pending = None
        if done.cancelled() or done.result().success:
            return
        self._is_changed = True
        self._warn(f'{_SERVICE}: {path} not loaded: the log of the route server has the reason')

    def _warn(self, text: str) -> None:
        self._node.get_logger().warning(text, throttle_duration_sec=WARN_PERIOD_S)
