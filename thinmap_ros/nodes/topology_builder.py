"""The topological map: the cells of the grid that change are thinned and merged into the graph."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from rclpy.node import Node

from thinmap_msgs.msg import LocalGrid, ProbabilityGrid
from thinmap_msgs.msg import TopologicalMap as TopologicalMapMsg
from thinmap_ros import kernels
from thinmap_ros.core import snapshot
from thinmap_ros.core.errors import counted
from thinmap_ros.core.snapshot import State
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.segmentation import FIELDS as REGION_FIELDS
from thinmap_ros.core.topology.segmentation import RegionTracker
from thinmap_ros.core.topology.topology import Topology, TopologyBuilder
from thinmap_ros.files.sessions import REGIONS, TOPOLOGY, load_topology
from thinmap_ros.nodes.parts.topology import RegionUpdates, RouteGraphUpdates
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.checkpoint import StateStamp
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.localized_scan import map_update_from_msg
from thinmap_ros.ros.maps import UNKNOWN, FollowedMap, Origin
from thinmap_ros.ros.session_services import (
    SaveDirectory,
    offer_loading,
    offer_saving,
)
from thinmap_ros.ros.subscription import subscribe_all

_ID_RESERVE = 1000  # ids that a builder may have assigned after its last checkpoint


class _GraphPublisher:
    """Publishes graphs on a latched topic, which gives the newest one to late subscribers."""

    def __init__(self, node: Node, topic: str, frame_id: str) -> None:
        self._topic = node.create_publisher(TopologicalMapMsg, topic, qos.LATCHED)
        self._frame_id = frame_id
        self._latched: TopologicalMapMsg | None = None

    @property
    def has_published(self) -> bool:
        return self._latched is not None

    @property
    def has_subscribers(self) -> bool:
        return bool(self._topic.get_subscription_count())

    def publish(
        self, topology: TopologicalMap, stamp_ns: int, map_id: int = UNKNOWN, again: bool = False
    ) -> bool:
        """Publish a graph; one that is latched already only if `again`. Returns whether it was."""
        message = messages.topology_msg(topology, self._frame_id, stamp_ns, map_id)
        is_latched = self._latched is not None and messages.is_same_topology(message, self._latched)
        if is_latched and not again:
            return False
        self._topic.publish(message)
        self._latched = message
        return True


class TopologyBuilderNode(ThinmapNode):
    """/local_grid and /grid in; /local_topology, /topology and /regions out.

    Services save_topology, load_topology and check_topology, which reads a saved graph without
    replacing the present one; name_region, which gives a region a name. A graph is published when
    it has changed, /local_topology for each scan while somebody subscribes to it. Where Nav2's
    route server runs, it is given the route graph of `map_to_graph`, with areas of /keep_out as
    walls, when that has changed, and when the graph is saved: client of
    route_server/set_route_graph.
    Cells outside of the windows are those of /grid. After a correction the graph is rebuilt from
    the /grid that has undergone it, in a thread; until then the graph stays as it is. Nodes keep
    their ids.
    """

    def __init__(self) -> None:
        super().__init__('topology_builder', recovers=True)
        self._config = parameters.declare_config(self, TopologyConfig)
        self._frame_id = parameters.declare_map_frame(self)
        self._local = _GraphPublisher(self, 'local_topology', self._frame_id)
        self._published = _GraphPublisher(self, 'topology', self._frame_id)
        self._session = parameters.declare_session(self)
        self._save_directory = SaveDirectory(self)
        offer_saving(self, self._save_directory, TOPOLOGY, self._save_and_route, self._save_at_end)
        self._route_graph = RouteGraphUpdates(
            self, self._frame_id, self._config, lambda: self._topology.builder
        )
        self._regions = RegionUpdates(
            self, self._frame_id, self._config.robot_radius_m, lambda: self._topology.map
        )
        parameters.reject_unknown(self)
        kernels.topology_builder()
        subscribe_all(
            self,
            (ProbabilityGrid, 'grid', self._on_grid, qos.LATCHED),
            (LocalGrid, 'local_grid', self._on_local_grid, qos.STREAM),
        )
        offer_loading(self, TOPOLOGY, self._check, self._load)
        self.diagnostics.check_sole_publisher('topology')
        self._stamp = StateStamp()
        self._topology = Topology(self._config, _begin_in_thread)
        self.reset_state()
        self.enable_checkpoint(self._state, self._restore)

    def _state(self) -> State | None:
        if self._stamp.latest_ns is None:
            return None
        latest_ns = np.array(self._stamp.latest_ns)
        return {**self._topology.state(), **self._regions.tracker.state(), 'latest_ns': latest_ns}

    def _restore(self, state: State) -> None:
        """Continue with the graph of a killed builder. Raises InputError where it is no graph."""
        latest_ns, rest = snapshot.split_number(state, 'latest_ns')
        regions, graph = snapshot.split(rest, REGION_FIELDS)
        tracker = RegionTracker.from_state(regions, self._regions.config)
        self._topology.restore(graph)
        for restored in (self._topology.builder, tracker):
            restored.skip_ids(_ID_RESERVE)
        self._regions.reset(tracker)
        self._route_graph.reset()
        self._stamp.restore(latest_ns)
        self._publish(latest_ns)

    def reset_state(self) -> None:
        """Discard the graph, or return to the session that the node was started with."""
        self._followed = FollowedMap()
        self._newest_saved_id = 0
        self._topology.reset()
        self._route_graph.reset()
        if self._session:
            self._topology.replace(load_topology(self._session, self._config))
            self._regions.reset(REGIONS.load_optional(self._session, self._regions.config))
            graph = self._topology.map
            counts = f'{counted(len(graph.nodes), "node")}, {counted(len(graph.edges), "edge")}'
            self.get_logger().info(f'loaded {self._session}: {counts}')
        else:
            self._regions.reset()
        if self._session or self._published.has_published:
            self._publish(self.now_ns)

    def _is_of_this_map(self, message: ProbabilityGrid) -> bool:
        """Whether a grid is of the map of this graph; a graph of another map is discarded."""
        origin = self._followed.origin(message.map_id)
        if origin is Origin.OTHER:
            self.reset('grid is of another map')
            self._followed.origin(message.map_id)
        return origin is not Origin.STALE

    def _on_local_grid(self, message: LocalGrid) -> None:
        if not self._is_of_this_map(message.grid):
            return
        update = map_update_from_msg(message)
        stamp_ns = update.localized.scan.stamp_ns
        if self._stamp.is_restarted_by(stamp_ns):
            self.reset_state()
        self._stamp.latest_ns = stamp_ns
        with self.diagnostics.time_step('graph update'):
            changed = self._topology.step(update)
        # The first one is published even if it is empty: others wait for the graph of the map.
        if changed is not None or not self._published.has_published:
            self._publish(stamp_ns, again=False)
        # The local map comes last: a subscriber that receives it has all results of this scan. It
        # may wait for the result of each scan (lockstep).
        is_heard = self._local.has_subscribers
        self._local.publish(self._topology.builder.local_map(), stamp_ns, again=is_heard)

    def _on_grid(self, message: ProbabilityGrid) -> None:
        if not self._is_of_this_map(message):
            return
        stamp_ns = messages.stamp_ns(message.header.stamp)
        whole = messages.whole_map_from_msg(message)
        self._regions.tracker.follow(whole)
        self._regions.add_grid(stamp_ns, whole.patch)
        self._route_graph.map_changed()
        with self.diagnostics.time_step('whole map'):
            changed = self._topology.add_map(whole)
        if changed is not None:
            self._publish(stamp_ns, again=False)

    def _publish(self, stamp_ns: int, again: bool = True) -> None:
        self._checkpoint_new_ids()
        map_id = self._followed.id
        if self._published.publish(self._topology.map, stamp_ns, map_id, again):
            self._route_graph.map_changed()
            self._regions.graph_changed()

    def _checkpoint_new_ids(self) -> None:
        """Save a checkpoint before new ids are published: other nodes may rely on them."""
        newest = max(self._topology.map.nodes, default=0)
        if newest != self._newest_saved_id and self.checkpoint_now():
            self._newest_saved_id = newest

    def _save_and_route(self, path: str, overwrite: bool) -> str:
        saved = self._save(path, overwrite)
        self._route_graph.graph_saved()
        return saved

    def _save(self, path: str, overwrite: bool = False) -> str:
        saved = TOPOLOGY.save(path, self._topology.builder, overwrite)
        REGIONS.save(path, self._regions.tracker)
        return f'saved {saved}'

    def _save_at_end(self, path: str) -> str:
        return self._save(path) if self._topology.map.nodes else ''

    def _check(self, path: str) -> str:
        return f'graph of {len(self._read(path)[0].map.nodes)} nodes'

    def _read(self, path: str) -> tuple[TopologyBuilder, RegionTracker | None]:
        """Saved graph and regions; empty ones if the path is empty."""
        if not path:
            return TopologyBuilder(self._config), None
        resolved = self._save_directory.resolve(path)
        graph = load_topology(resolved, self._config)
        return graph, REGIONS.load_optional(resolved, self._regions.config)

    def _load(self, path: str) -> str:
        """Replace the graph by a saved one; windows that were made before are discarded."""
        loaded, regions = self._read(path)
        self._topology.replace(loaded)
        self._followed.leave()
        self._regions.reset(regions)
        self._route_graph.reset()
        self._publish(self.now_ns)
        return f'graph of {len(loaded.map.nodes)} nodes' if path else 'graph reset'


def _begin_in_thread(work: Callable[[], TopologyBuilder]) -> Future[TopologyBuilder]:
    """Begin to rebuild a graph, so that no scan waits."""
    thread = ThreadPoolExecutor(max_workers=1)
    job = thread.submit(work)
    thread.shutdown(wait=False)
    return job


main = node_main.program(TopologyBuilderNode)

if __name__ == '__main__':
    main()
