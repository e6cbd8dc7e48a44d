"""Parts of the topology builder: regions with names, and the route graph."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from geometry_msgs.msg import Point
from nav2_msgs.srv import SetRouteGraph
from rclpy.client import Client
from rclpy.task import Future as AnswerFuture

from thinmap_msgs.msg import Door as DoorMsg
from thinmap_msgs.msg import KeepOut as KeepOutMsg
from thinmap_msgs.msg import Region as RegionMsg
from thinmap_msgs.msg import RegionArray
from thinmap_msgs.srv import NameRegion
from thinmap_ros import kernels
from thinmap_ros.core import errors
from thinmap_ros.core.config import Config, parameter, part
from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.core.grid.edits import KeepOut
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array, Cells
from thinmap_ros.core.snapshot import State
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.regions import (
    Door,
    Membership,
    Region,
    RegionMap,
    checked_name,
    membership_of,
)
from thinmap_ros.core.topology.segmentation import RegionConfig, RegionTracker
from thinmap_ros.core.topology.topology import (
    SavedTopology,
    TopologyBuilder,
    build_routes,
    unpack,
    with_ids_of,
)
from thinmap_ros.files.graphs import write_geojson
from thinmap_ros.jit.cache import private_folder, temporary_folder
from thinmap_ros.logs import decode
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.checkpoint import own_file_name
from thinmap_ros.ros.lifecycle_node import Result, ThinmapNode, Worker
from thinmap_ros.ros.services import offer
from thinmap_ros.ros.subscription import WARN_PERIOD_S, subscribe_guarded
from thinmap_ros.ros.time_jumps import STEADY


def region_array_msg(membership: Membership, frame_id: str, ns: int) -> RegionArray:
    """Message of all regions and doors, with the nodes and edges of the graph in them."""
    nodes = _ids_by_region(membership.of_node)
    edges = _ids_by_region(membership.of_edge)
    regions = membership.regions
    return RegionArray(
        header=messages.header(frame_id, ns),
        regions=[
            _region_msg(region, nodes.get(region.id, []), edges.get(region.id, []))
            for region in regions.regions.values()
        ],
        doors=[_door_msg(door, membership.edges_through(door)) for door in regions.doors],
    )


def _ids_by_region(of: Mapping[int, int]) -> dict[int, list[int]]:
    """Ids of nodes or edges by region, given the region of each."""
    found: dict[int, list[int]] = {}
    for number, region in of.items():
        found.setdefault(region, []).append(number)
    return found


def _region_msg(region: Region, node_ids: list[int], edge_ids: list[int]) -> RegionMsg:
    return RegionMsg(
        id=region.id,
        name=region.name,
        kind=int(region.kind),
        center=Point(x=region.x, y=region.y),
        area_m2=region.area_m2,
        outline=messages.polygon_msg(region.outline.tolist()),
        node_ids=node_ids,
        edge_ids=edge_ids,
    )


def _door_msg(door: Door, edge_ids: list[int]) -> DoorMsg:
    return DoorMsg(
        region_a=door.a,
        region_b=door.b,
        position=Point(x=door.x, y=door.y),
        width_m=door.width_m,
        edge_ids=edge_ids,
    )


# Of a core, that a worker uses at most: on a map of 100 x 100 m regions take more than a second.
_MAX_CPU_SHARE = 0.1


@dataclass(frozen=True)
class RegionUpdatesConfig(Config):
    """When the regions are computed, and what counts as one."""

    region_update_period_s: float = parameter(
        5.0,
        'Least time between two updates of the topic regions (s). Where computing takes more than '
        'a tenth of it, updates are rarer. Raise it for a slow computer, lower it for names of '
        'rooms as soon as they are seen. 0: no regions.',
        low=0.0,
        high=3600.0,
    )
    regions: RegionConfig = part(RegionConfig)


def _regions_of(tracker: RegionTracker, patch: GridPatch, before: GridPatch | None) -> RegionMap:
    """Regions of a grid; the known ones, if no cell shows another than those of before."""
    known = tracker.regions
    if known is not None and before is not None and _shows_the_same(patch, before):
        return known
    return tracker.update(patch)


def _shows_the_same(patch: GridPatch, before: GridPatch) -> bool:
    """Whether the same cells are free, and the same ones occupied, as in a patch of before."""
    is_same_rectangle = patch.frame == before.frame and patch.shape == before.shape
    return is_same_rectangle and np.array_equal(patch.trinary(), before.trinary())


class RegionUpdates:
    """/regions out: all regions of the newest grid, with nodes and edges in them; name_region.

    config: what counts as a region; tracker: the regions and their ids. Regions are computed in a
    thread of their own, so that no scan waits for them.
    """

    def __init__(
        self,
        node: ThinmapNode,
        frame_id: str,
        robot_radius_m: float,
        topology: Callable[[], TopologicalMap],
    ) -> None:
        """Declare the parameters; topology: returns the present graph, in the frame frame_id."""
        self._node = node
        self._frame_id = frame_id
        self._topology = topology
        config = parameters.declare_config(node, RegionUpdatesConfig)
        self.config = replace(config.regions, robot_radius_m=robot_radius_m)
        self._worker = Worker(node, _MAX_CPU_SHARE, partial(node.step_failed, 'regions'))
        self._published: RegionMap | None = None
        self._is_graph_newer = False
        self.reset()
        offer(node.create_active_service, NameRegion, 'name_region', self._name)
        if config.region_update_period_s > 0.0:
            self._publisher = node.create_publisher(RegionArray, 'regions', qos.LATCHED)
            node.create_active_timer(config.region_update_period_s, self._begin, clock=STEADY)

    def reset(self, tracker: RegionTracker | None = None) -> None:
        """Forget the grid, and continue with the ids of a tracker; None: of none."""
        self.tracker = tracker or RegionTracker(self.config)
        self._worker.drop()
        self._last: GridPatch | None = None
        self._published_ns = 0
        self._newest: tuple[int, GridPatch] | None = None

    def add_grid(self, stamp_ns: int, patch: GridPatch) -> None:
        """The newest grid, whose regions are to be published."""
        self._newest = (stamp_ns, patch)

    def graph_changed(self) -> None:
        """The graph has other nodes or edges, which are to be published with their regions."""
        self._is_graph_newer = True

    def _begin(self) -> None:
        """Begin to compute the regions of the newest grid; of the same grid with a new graph."""
        if self._worker.is_busy:
            return
        if self._newest is not None and not self._worker.is_resting:
            stamp_ns, patch = self._newest
            self._newest = None
            self._worker.begin(partial(self._compute, self.tracker, stamp_ns, patch, self._last))
            self._last = patch
        elif self._is_graph_newer and self.tracker.regions is not None:
            self._publish(self.tracker.regions)

    def _compute(
        self, tracker: RegionTracker, stamp_ns: int, patch: GridPatch, before: GridPatch | None
    ) -> Result:
        """Find the regions of a grid, in the thread of the worker."""
        regions = _regions_of(tracker, patch, before)
        return lambda: self._publish_computed(stamp_ns, regions)

    def _publish_computed(self, stamp_ns: int, regions: RegionMap) -> None:
        """Publish the regions that were computed, if they or the graph are new."""
        self._published_ns = stamp_ns
        if regions is not self._published or self._is_graph_newer:
            self._publish(regions)

    def _publish(self, regions: RegionMap) -> None:
        """Publish regions with their names, and the nodes and edges of the present graph."""
        self._is_graph_newer = False
        self._published = regions
        with self._node.diagnostics.time_step('regions published'):
            membership = membership_of(self._topology(), self.tracker.names.named(regions))
            message = region_array_msg(membership, self._frame_id, self._published_ns)
        self._publisher.publish(message)

    def _name(self, request: NameRegion.Request) -> str:
        """Give a region a name, which stays at its place in the building."""
        regions = self.tracker.regions
        if regions is None:
            raise InputError('no regions yet: expected a map, and region_update_period_s above 0')
        name = checked_name(request.name)
        number, anchor = _anchor(regions, request)
        self.tracker.names.put(regions, number, anchor, name)
        self._publish(regions)
        self._node.checkpoint_now()
        return f'region {number}: {name}' if name else f'region {number}: no name'


def _anchor(regions: RegionMap, request: NameRegion.Request) -> tuple[int, Array]:
    """Id of a region, and the place (2,) of its name. Raises InputError where there is none."""
    if request.id:
        region = regions.regions.get(request.id)
        if region is None:
            raise InputError(f'region {request.id}: expected the id of a region of the map')
        return request.id, np.array([region.x, region.y])
    place = (request.point.x, request.point.y)
    errors.require_bounded('point', place)
    number = int(regions.ids_at(np.array([place]))[0])
    if not number:
        raise InputError(f'point {place[0]:g}, {place[1]:g}: expected a point in a region')
    return number, np.array(place)


_SERVICE = 'route_server/set_route_graph'
# Above all ids of the topological map, which counts from 1, and small enough for two in 32 bits.
_FIRST_ID = 1_000_000_000


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


class RouteGraph:
    """The route graph of the newest map, by the rules of `map_to_graph`, with ids that stay.

    Nodes and edges have the ids of those of the topological map that they continue; all others,
    which the map that grows does not have, ids from _FIRST_ID on.
    """

    def __init__(self, config: TopologyConfig, write: Callable[[TopologicalMap], None]) -> None:
        self._config = replace(config, max_unknown_gap_m=0.0)
        self._write = write
        self._next_id = _FIRST_ID
        self._graph = TopologicalMap()
        self._source: tuple[GridPatch, set[int], Cells] | None = None

    def update(self, state: State, keep_out: KeepOut, is_forced: bool) -> TopologicalMap:
        """Write the graph of the `state` of a builder; the one of before, if it is the same.

        keep_out: areas that are walls. is_forced: write it again even if it is the same. Raises
        InputError or OSError where it cannot be written.
        """
        saved = unpack(state)
        patch = keep_out.as_walls(saved.patch)
        nodes = set(saved.map.nodes)
        before = self._source
        places = saved.robot_places
        if (
            before is None
            or nodes != before[1]
            or not np.array_equal(places, before[2])
            or not _shows_the_same(patch, before[0])
        ):
            graph = self._continued(saved, patch)
            is_forced |= not _is_same(graph, self._graph)
        else:
            graph = self._graph
        if is_forced and graph.edges:
            self._write(graph)
        self._source = (patch, nodes, places)
        self._graph = graph if is_forced else self._graph
        return self._graph

    def _continued(self, saved: SavedTopology, patch: GridPatch) -> TopologicalMap:
        """The graph of what is reached from where the robot has been, with known ids."""
        starts = saved.frame.centres_of(saved.robot_places)
        found = build_routes(patch, starts, self._config).map
        known = TopologicalMap(
            (self._graph.nodes | saved.map.nodes).values(),
            (self._graph.edges | saved.map.edges).values(),
        )
        graph = with_ids_of(known, found, self._next_id)
        self._next_id = max([self._next_id - 1, *graph.nodes, *graph.edges]) + 1
        return graph


def _is_same(graph: TopologicalMap, other: TopologicalMap) -> bool:
    """Whether two route graphs are written as the same."""
    return graph.nodes == other.nodes and _values(graph) == _values(other)


def _values(graph: TopologicalMap) -> set[tuple[float, ...]]:
    return {(e.id, e.a, e.b, e.length_m, e.clearance_m) for e in graph.edges.values()}


class RouteGraphUpdates:
    """Writes the route graph after changes, and has Nav2's route server load it.

    Areas of /keep_out are walls. A graph without edges is never sent, as the route server refuses
    it. A route server that starts later, or has refused a graph, receives the one of that time.
    """

    def __init__(
        self,
        node: ThinmapNode,
        frame_id: str,
        topology_config: TopologyConfig,
        builder: Callable[[], TopologyBuilder],
    ) -> None:
        """Declare the parameters; builder: returns that of the present graph, in frame_id."""
        self._node = node
        self._frame_id = frame_id
        self._topology_config = topology_config
        self._builder = builder
        self._config = parameters.declare_config(node, RouteGraphConfig)
        self._keep_out = KeepOut()
        self._worker = Worker(node, _MAX_CPU_SHARE, self._on_failed)
        self._client: Client | None = None
        self._was_ready = False
        self._pending: AnswerFuture | None = None
        self.reset()
        if self._config.route_graph_period_s > 0.0:
            kernels.route_graph()
            self._client = node.create_client(SetRouteGraph, _SERVICE)
            subscribe_guarded(node, KeepOutMsg, 'keep_out', self._on_keep_out, qos.LATCHED)
            node.create_active_timer(self._config.route_graph_period_s, self._update, clock=STEADY)

    def reset(self) -> None:
        """Forget the map with its ids: the next one is another."""
        self._routes = RouteGraph(self._topology_config, self._write)
        self._worker.drop()
        self._sent: TopologicalMap | None = None
        self._is_changed = False
        self._is_urgent = False

    def map_changed(self) -> None:
        """Update the route server at the end of the period."""
        self._is_changed = True

    def graph_saved(self) -> None:
        """Update the route server at once."""
        self._sent = None
        self._update_at_once()

    def _on_keep_out(self, message: KeepOutMsg) -> None:
        """Update the route server at once if areas come or go; a correction only moves them."""
        before = {area.id for area in self._keep_out.areas}
        self._keep_out = decode.keep_out(message)
        self._is_changed = True
        if before != {area.id for area in self._keep_out.areas}:
            self._update_at_once()

    def _update_at_once(self) -> None:
        self._is_changed = True
        self._is_urgent = True
        self._update()

    def _update(self) -> None:
        """Begin to find the route graph, if the route server may need another one."""
        if self._client is None:
            return
        is_ready = self._client.service_is_ready()
        if is_ready and not self._was_ready:
            self._sent = None
            self._is_changed = True
        self._was_ready = is_ready
        if not self._is_changed or not (is_ready or self._config.route_graph_path):
            return
        must_wait = self._worker.is_resting and not self._is_urgent
        if self._worker.is_busy or must_wait or not self._builder().map.nodes:
            return
        self._is_changed = False
        self._is_urgent = False
        with self._node.diagnostics.time_step('route graph'):
            state = self._builder().state()
        is_forced = self._sent is None
        self._worker.begin(partial(self._find, self._routes, state, self._keep_out, is_forced))

    def _find(self, routes: RouteGraph, state: State, keep_out: KeepOut, is_forced: bool) -> Result:
        """Find and write the route graph, in the thread of the worker."""
        graph = routes.update(state, keep_out, is_forced)
        return lambda: self._send_found(graph)

    def _on_failed(self, error: Exception) -> None:
        self._is_changed = True
        self._warn(f'route graph not written: {one_line_reason(error)}')

    def _send_found(self, graph: TopologicalMap) -> None:
        """Have the route server load the graph that was found, unless it has it."""
        if not graph.edges and self._keep_out.areas:
            self._warn('no edges outside of keep-out areas: the route server keeps its last graph')
        if graph.edges and graph is not self._sent:
            self._sent = graph
            if self._client is not None and self._was_ready:
                self._send(self._client, self._path())
        if self._is_urgent:
            self._update()

    def _write(self, graph: TopologicalMap) -> None:
        write_geojson(self._path(), graph, frame_id=self._frame_id, with_paths=False)

    def _path(self) -> Path:
        if self._config.route_graph_path:
            return Path(self._config.route_graph_path).resolve()
        return private_folder(temporary_folder()) / own_file_name(self._node, '.geojson')

    def _send(self, client: Client, path: Path) -> None:
        if self._pending is not None:
            client.remove_pending_request(self._pending)
        self._pending = client.call_async(SetRouteGraph.Request(graph_filepath=str(path)))
        self._pending.add_done_callback(lambda done: self._on_answer(done, path))

    def _on_answer(self, done: AnswerFuture, path: Path) -> None:
        self._pending = None
        if done.cancelled() or done.result().success:
            return
        self._sent = None
        self._is_changed = True
        self._warn(f'{_SERVICE}: {path} not loaded: the log of the route server has the reason')

    def _warn(self, text: str) -> None:
        self._node.get_logger().warning(text, throttle_duration_sec=WARN_PERIOD_S)
