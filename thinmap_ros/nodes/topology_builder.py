"""The topological map: the window of every scan is thinned and merged into the global graph."""

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Path

from thinmap_msgs.msg import TopologicalMap
from thinmap_msgs.srv import LoadMap, SaveMap
from thinmap_ros.core import snapshot
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stamp_matcher import StampMatcher
from thinmap_ros.core.topology.builder import TopologyBuilder, TopologyConfig
from thinmap_ros.core.topology.rebuild import Rebuilding
from thinmap_ros.files import sessions
from thinmap_ros.kernels import warm_up
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.checkpoint import State
from thinmap_ros.ros.lifecycle_node import LiveNode
from thinmap_ros.ros.save_folder import SaveFolder
from thinmap_ros.ros.services import answer
from thinmap_ros.ros.subscription import listen

_UNTOLD_IDS = 1000  # ids that a builder may have given after its state was kept last


class TopologyBuilderNode(LiveNode):
    """/local_map and /pose in; /local_topology and /topology out.

    Services save_topology and load_topology.
    After a /trajectory the graph is rebuilt from the /map that has undergone that correction; until
    it comes the graph stays as it is. Nodes keep their ids.
    """

    def __init__(self) -> None:
        super().__init__('topology_builder', recovers=True)
        self._config = parameters.declare(self, TopologyConfig)
        self._map_frame = parameters.declare_value(self, 'map_frame', 'map', 'frame of the map')
        self._session = parameters.declare_session(self)
        self._saves = SaveFolder(self)
        parameters.check_unknown(self)
        warm_up.topology_builder()
        self._said_something = False
        self._newest_kept = 0
        self._local = self.create_publisher(TopologicalMap, 'local_topology', qos.LATCHED)
        self._global = self.create_publisher(TopologicalMap, 'topology', qos.LATCHED)
        listen(self, Path, 'trajectory', self._on_trajectory, qos.LATCHED)
        listen(self, OccupancyGrid, 'map', self._on_map, qos.LATCHED)
        listen(self, OccupancyGrid, 'local_map', self._on_window, qos.STREAM)
        listen(self, PoseWithCovarianceStamped, 'pose', self._on_pose, qos.STREAM)
        self.create_service(SaveMap, 'save_topology', self._on_save)
        self.create_service(LoadMap, 'load_topology', self._on_load)
        self.health.sole_publisher_of('topology')
        self._latest_ns: int | None = None
        self._resumed_ns: int | None = None
        self._taken_over_ns = 0
        self.begin_anew()
        self.keep(self._state, self._resume)

    def _state(self) -> State | None:
        if self._latest_ns is None:
            return None
        return {**self._builder.state(), 'latest_ns': np.array(self._latest_ns)}

    def _resume(self, left: State) -> None:
        """Take over the graph of a builder that was killed. Raises InputError where it is none."""
        latest_ns, graph = snapshot.split_stamp(left)
        builder = TopologyBuilder.from_state(graph, self._config)
        builder.skip_ids(_UNTOLD_IDS)
        self._resumed_ns = self._latest_ns = self._taken_over_ns = latest_ns
        self._builder = builder
        self._rebuilding = Rebuilding(from_the_start=False)
        self._publish(latest_ns)

    def begin_anew(self) -> None:
        """Forget the graph, or go back to the session that the node was started with."""
        self._matcher: StampMatcher[GridPatch, Array] = StampMatcher()
        self._newest_kept = 0
        self._rebuilding = Rebuilding(from_the_start=not self._session)
        self._builder = self._of_session() if self._session else TopologyBuilder(self._config)
        if self._session or self._said_something:
            self._publish(self.get_clock().now().nanoseconds)

    def _of_session(self) -> TopologyBuilder:
        return sessions.load_topology(self._session, self._config)

    def _on_window(self, message: OccupancyGrid) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        patch = messages.patch_from(message)
        self._rebuilding.window(patch, messages.stamp_ns(message.info.map_load_time))
        self._take(stamp_ns, self._matcher.add_left(stamp_ns, patch))

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        pair = self._matcher.add_right(stamp_ns, messages.pose_from(message.pose.pose))
        self._take(stamp_ns, pair)

    def _take(self, stamp_ns: int, pair: tuple[GridPatch, Array] | None) -> None:
        self.health.dropped_in_all('local maps and poses without a partner', self._matcher.dropped)
        if pair is None:
            return
        if self._resumed_ns is not None and stamp_ns < self._resumed_ns:
            self.begin_anew()  # the robot has begun anew as well
        self._resumed_ns = None
        self._latest_ns = stamp_ns
        window, T_map_base = pair
        with self.health.timed('graph update'):
            changed = self._rebuilding.accepts_window() and self._builder.update(window, T_map_base)
        self._rebuilding.add_pose(stamp_ns, T_map_base)
        if changed:
            self._publish(stamp_ns)
        # The local map comes last: who hears it knows that all of this scan is said.
        self._local.publish(
            messages.topology_msg(self._builder.local_map(), self._map_frame, stamp_ns)
        )

    def _on_trajectory(self, message: Path) -> None:
        corrected_ns = messages.stamp_ns(message.header.stamp)
        # A latched one may be of before the graph that was taken over, which then has undergone it.
        if self._latest_ns is not None and corrected_ns > self._taken_over_ns:
            self._rebuilding.correct(corrected_ns, *messages.trajectory_from(message))

    def _on_map(self, message: OccupancyGrid) -> None:
        if not self._rebuilding.awaits(messages.stamp_ns(message.info.map_load_time)):
            return
        with self.health.timed('graph rebuilt'):
            self._rebuilding.rebuild(self._builder, messages.patch_from(message))
        self._publish(messages.stamp_ns(message.header.stamp))

    def _publish(self, stamp_ns: int) -> None:
        self._said_something = True
        self._keep_new_ids()
        self._global.publish(messages.topology_msg(self._builder.map, self._map_frame, stamp_ns))

    def _keep_new_ids(self) -> None:
        """Whoever hears of a node may rely on its id.

        It is kept first, and not only when the next time has come.
        """
        newest = max(self._builder.map.nodes, default=0)
        if newest != self._newest_kept and self.keep_news():
            self._newest_kept = newest

    def _on_save(self, request: SaveMap.Request, response: SaveMap.Response) -> SaveMap.Response:
        def save() -> str:
            path = self._saves.inside(request.path)
            return f'saved {sessions.save_topology(path, self._builder)}'

        return answer(response, save)

    def _on_load(self, request: LoadMap.Request, response: LoadMap.Response) -> LoadMap.Response:
        return answer(response, lambda: self._load(request.path))

    def _load(self, path: str) -> str:
        """Take over what was saved; what is on its way from before is forgotten."""
        loaded = TopologyBuilder(self._config)
        if path:
            inside = self._saves.inside(path)
            resolution_m = self._builder.resolution_m
            loaded = sessions.load_topology(inside, self._config, resolution_m)
        self._builder = loaded
        self._matcher = StampMatcher()
        self._rebuilding = Rebuilding(from_the_start=not path)
        self._publish(self.get_clock().now().nanoseconds)
        return f'graph of {len(loaded.map.nodes)} nodes' if path else 'the graph begins anew'


def main() -> None:
    """Run the node."""
    node_main.run(TopologyBuilderNode)


if __name__ == '__main__':
    main()
