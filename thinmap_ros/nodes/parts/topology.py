"""Parts of the topology builder: regions with names, and the route graph."""

import os
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic

import numpy as np
from geometry_msgs.msg import Point
from nav2_msgs.srv import SetRouteGraph
from rclpy.client import Client
from rclpy.task import Future as AnswerFuture

from thinmap_msgs.msg import Door as DoorMsg
from thinmap_msgs.msg import Region as RegionMsg
from thinmap_msgs.msg import RegionArray
from thinmap_msgs.srv import NameRegion
from thinmap_ros.core import errors
from thinmap_ros.core.config import Config, parameter, part
from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.core.topology.regions import (
    Door,
    Membership,
    Region,
    RegionMap,
    checked_name,
    membership_of,
)
from thinmap_ros.core.topology.segmentation import RegionConfig, RegionTracker
from thinmap_ros.files.graphs import write_geojson
from thinmap_ros.jit.cache import private_folder, temporary_folder
from thinmap_ros.kernels import release_free_pages
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.services import offer
from thinmap_ros.ros.subscription import WARN_PERIOD_S
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


_POLL_S = 0.1
# Of a core, that is used for regions at most: on a map of 100 x 100 m they take more than a second.
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


class _RegionJob:
    """Computes regions in a thread of its own, where the map has changed since the last time."""

    def __init__(self, tracker: RegionTracker) -> None:
        self.tracker = tracker
        self._worker = ThreadPoolExecutor(1, thread_name_prefix='regions')
        self._last: GridPatch | None = None
        self._rests_until_s = 0.0

    @property
    def is_resting(self) -> bool:
        """Whether the last regions took so long that the next ones have to wait."""
        return monotonic() < self._rests_until_s

    def submit(self, patch: GridPatch) -> Future[RegionMap]:
        """Begin to compute the regions of a grid; those of before, if no cell shows another."""
        return self._worker.submit(self._regions_of, patch)

    def _regions_of(self, patch: GridPatch) -> RegionMap:
        before = self._last
        self._last = patch
        known = self.tracker.regions
        if known is not None and before is not None and _shows_the_same(patch, before):
            return known
        began_s = monotonic()
        regions = self.tracker.update(patch)
        # On a large map this takes, and frees, a hundred bytes a cell.
        release_free_pages()
        ended_s = monotonic()
        self._rests_until_s = ended_s + (ended_s - began_s) / _MAX_CPU_SHARE
        return regions


def _shows_the_same(patch: GridPatch, before: GridPatch) -> bool:
    """Whether the same cells are free, and the same ones occupied, as in a patch of before."""
    is_same_rectangle = patch.frame == before.frame and patch.shape == before.shape
    return is_same_rectangle and np.array_equal(patch.trinary(), before.trinary())


class RegionUpdates:
    """/regions out: all regions of the newest grid, with nodes and edges in them.

    Regions are computed in a thread of their own, so that no scan waits for them.
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
        self._config = replace(config.regions, robot_radius_m=robot_radius_m)
        self._published: RegionMap | None = None
        self._is_graph_newer = False
        self.reset()
        if config.region_update_period_s > 0.0:
            self._publisher = node.create_publisher(RegionArray, 'regions', qos.LATCHED)
            node.create_active_timer(config.region_update_period_s, self._begin, clock=STEADY)
            # Only while regions are computed.
            self._poll = node.create_active_timer(_POLL_S, self._publish_computed, clock=STEADY)
            self._poll.cancel()

    @property
    def config(self) -> RegionConfig:
        """What counts as a region."""
        return self._config

    @property
    def tracker(self) -> RegionTracker:
        """The regions and their ids."""
        return self._job.tracker

    def reset(self, tracker: RegionTracker | None = None) -> None:
        """Forget the grid, and continue with the ids of a tracker; None: of none."""
        self._job = _RegionJob(tracker or RegionTracker(self._config))
        self._pending: Future[RegionMap] | None = None
        self._pending_ns = 0
        self._newest: tuple[int, GridPatch] | None = None

    def add_grid(self, stamp_ns: int, patch: GridPatch) -> None:
        """The newest grid, whose regions are to be published."""
        self._newest = (stamp_ns, patch)

    def graph_changed(self) -> None:
        """The graph has other nodes or edges, which are to be published with their regions."""
        self._is_graph_newer = True

    def publish_again(self) -> None:
        """Publish the regions, if there are any: their names are others."""
        if self.tracker.regions is not None:
            self._publish(self.tracker.regions)

    def _begin(self) -> None:
        """Begin to compute the regions of the newest grid; of the same grid with a new graph."""
        if self._pending is not None:
            return
        if self._newest is not None and not self._job.is_resting:
            self._pending_ns, patch = self._newest
            self._newest = None
            self._pending = self._job.submit(patch)
            self._poll.reset()
        elif self._is_graph_newer and self.tracker.regions is not None:
            self._publish(self.tracker.regions)

    def _publish_computed(self) -> None:
        """Publish the regions that were computed, if they or the graph are new."""
        if self._pending is not None and not self._pending.done():
            return
        self._poll.cancel()
        if self._pending is None:
            return
        pending = self._pending
        self._pending = None
        regions = pending.result()
        if regions is not self._published or self._is_graph_newer:
            self._publish(regions)

    def _publish(self, regions: RegionMap) -> None:
        """Publish regions with their names, and the nodes and edges of the present graph."""
        self._is_graph_newer = False
        self._published = regions
        with self._node.diagnostics.time_step('regions published'):
            membership = membership_of(self._topology(), self.tracker.names.named(regions))
            message = region_array_msg(membership, self._frame_id, self._pending_ns)
        self._publisher.publish(message)


class RegionNaming:
    """Service name_region: a region has a name, which stays at its place in the building."""

    def __init__(self, node: ThinmapNode, regions: RegionUpdates) -> None:
        self._node = node
        self._regions = regions
        offer(node.create_active_service, NameRegion, 'name_region', self._name)

    def _name(self, request: NameRegion.Request) -> str:
        tracker = self._regions.tracker
        regions = tracker.regions
        if regions is None:
            raise InputError('no regions yet: expected a map, and region_update_period_s above 0')
        name = checked_name(request.name)
        number, anchor = _anchor(regions, request)
        tracker.names.put(regions, number, anchor, name)
        self._regions.publish_again()
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
        self._pending: AnswerFuture | None = None
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

    def _on_answer(self, done: AnswerFuture, path: Path) -> None:
        self._pending = None
        if done.cancelled() or done.result().success:
            return
        self._is_changed = True
        self._warn(f'{_SERVICE}: {path} not loaded: the log of the route server has the reason')

    def _warn(self, text: str) -> None:
        self._node.get_logger().warning(text, throttle_duration_sec=WARN_PERIOD_S)
