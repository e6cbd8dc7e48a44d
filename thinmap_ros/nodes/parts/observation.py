"""What an explorer observes: map, graph, pose and scan, of thinmap or of other packages."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from time import monotonic

from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

from thinmap_msgs.msg import KeepOut as KeepOutMsg
from thinmap_msgs.msg import LocalGrid, ProbabilityGrid, TopologicalMap
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.exploration.mission import InputWatchdog
from thinmap_ros.core.exploration.strategy import Observation
from thinmap_ros.core.grid.edits import KeepOut
from thinmap_ros.core.grid.patch import GridPatch, occupancy_from_costs, scan_in_map
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.sensing.synchronizer import InputStream
from thinmap_ros.core.topology.graph import TopologicalMap as Topology
from thinmap_ros.core.topology.graph import TopologyConfig, topology_from_msg
from thinmap_ros.core.topology.topology import MapGraph
from thinmap_ros.logs import decode
from thinmap_ros.nodes.parts.driving import MAPPER_TIMEOUT_NS, POSE_TIMEOUT_NS
from thinmap_ros.nodes.parts.mission import ExplorationSettings
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.diagnostics import WARN
from thinmap_ros.ros.laser_transform import LaserTransform
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.localized_scan import localized_scan_from_msg
from thinmap_ros.ros.maps import UNKNOWN, FollowedMap, Origin, updates_topic
from thinmap_ros.ros.subscription import subscribe_all
from thinmap_ros.ros.tf import TransformListener


class ForeignMap:
    """Newest map of a topic, of a SLAM, a map server or a costmap, with its updates.

    is_changed: whether it has changed since somebody set this to False.
    """

    def __init__(
        self,
        node: ThinmapNode,
        settings: ExplorationSettings,
        map_frame: str,
        is_used: Callable[[], bool],
    ) -> None:
        """is_used: whether this map is needed; else its messages are only kept."""
        self.is_changed = False
        self._settings = settings
        self._map_frame = map_frame
        self._is_used = is_used
        self._unread: OccupancyGrid | None = None
        self._map = MapReceiver()
        updates = settings.costmap_updates_topic or updates_topic(node, self.topic)
        subscribe_all(
            node,
            (OccupancyGrid, self.topic, self._on_map, qos.LATCHED),
            (OccupancyGridUpdate, updates, self._on_update, qos.STREAM),
        )

    @property
    def topic(self) -> str:
        """Name of the topic."""
        return self._settings.costmap_topic

    def reset(self) -> None:
        """Discard the map."""
        self._unread = None
        self._map = MapReceiver()
        self.is_changed = False

    def patch(self) -> GridPatch | None:
        """The map as occupancy; None before the first. Raises InputError where it is invalid."""
        self._read_kept()
        patch = self._map.patch
        if patch is None:
            return None
        patch = occupancy_from_costs(patch) if self._settings.is_costmap else patch
        return replace(patch, is_replaced=True)

    def _on_map(self, message: OccupancyGrid) -> None:
        self._unread = message
        if self._is_used():
            self._read_kept()
        self.is_changed = True

    def _on_update(self, message: OccupancyGridUpdate) -> None:
        self._read_kept()
        self._check_frame(message.header.frame_id)
        # Stamps of costmaps and of their updates are times of different clocks, or 0.
        if self._map.update(0, *decode.map_update(message)):
            self.is_changed = True

    def _read_kept(self) -> None:
        message = self._unread
        self._unread = None
        if message is not None:
            self._check_frame(message.header.frame_id)
            self._map.replace(messages.grid_from_msg(message))

    def _check_frame(self, frame_id: str) -> None:
        if frame_id.lstrip('/') not in ('', self._map_frame):
            raise InputError(
                f'map in frame {quoted(frame_id)}: expected that of the parameter map_frame, '
                f'{quoted(self._map_frame)}'
            )


_MAX_SCANS = 50
_MAX_SCAN_AGE_NS = 2 * SECOND_NS


class RobotView:
    """Newest scan whose pose in the map TF knows, and that pose.

    Without scans, what the map shows around the robot stands for one. Of several lasers it is that
    of another one than the last time, if there is one.
    """

    def __init__(
        self,
        node: ThinmapNode,
        settings: ExplorationSettings,
        map_frame: str,
        laser_transform: LaserTransform,
    ) -> None:
        self._settings = settings
        self._map_frame = map_frame
        self._laser_transform = laser_transform
        self._node = node
        self._scans: deque[tuple[str, LaserScan]] = deque(maxlen=_MAX_SCANS)
        self._looked_in = ''  # frame of the last scan

    def reset(self) -> None:
        """Discard the scans."""
        self._scans.clear()

    def add_scan(self, topic: str, message: LaserScan) -> None:
        """Keep a scan of a topic until its pose is known."""
        self._scans.append((topic, message))

    def look(self, patch: GridPatch, now_ns: int) -> tuple[Scan, Array]:
        """Scan and pose (3,) in a map. Raises InputError where TF does not know the pose."""
        newest = reversed(self._scans)
        in_turn = sorted(newest, key=lambda each: each[1].header.frame_id == self._looked_in)
        for topic, message in in_turn:
            found = self._scan_at(topic, message, now_ns)
            if found is not None:
                self._looked_in = message.header.frame_id
                return found
        T_map_base = self.newest_pose(now_ns)
        return scan_in_map(patch, T_map_base, self._settings.view_range_m, now_ns), T_map_base

    @cached_property
    def _transforms(self) -> TransformListener:
        """From the first look on: each transform costs time, and most explorations need none."""
        return TransformListener(self._node)

    def _scan_at(self, topic: str, message: LaserScan, now_ns: int) -> tuple[Scan, Array] | None:
        try:
            scan = self._laser_transform.to_scan(topic, message)
            if abs(now_ns - scan.odometry_ns) > _MAX_SCAN_AGE_NS:
                return None
            base_frame = self._laser_transform.base_frame
            T_map_base = self._transforms.lookup(self._map_frame, base_frame, scan.odometry_ns)
        except InputError:
            return None
        return None if scan.is_blind else (scan, T_map_base)

    def newest_pose(self, now_ns: int) -> Array:
        """Newest pose (3,) that is not too old. Raises InputError where TF knows none."""
        tolerance_ns = round(self._settings.transform_tolerance * SECOND_NS)
        base_frame = self._laser_transform.base_frame
        return self._transforms.lookup_lately(self._map_frame, base_frame, now_ns, tolerance_ns)


_PERIOD_S = 1.0


class PublisherCheck:
    """Whether somebody publishes one of some topics; looked up once a second."""

    def __init__(self, node: Node, *topics: str) -> None:
        self._node = node
        self._topics = topics
        self._is_found = False
        self._checked_s = -_PERIOD_S

    def is_found(self) -> bool:
        """Whether there is a publisher."""
        if monotonic() - self._checked_s >= _PERIOD_S:
            # rclpy counts the publishers of a name as it is, without the node's remapping rules.
            names = map(self._node.resolve_topic_name, self._topics)
            self._set(any(map(self._node.count_publishers, names)))
        return self._is_found

    def message_received(self) -> None:
        """Register a message: its publisher may not be discovered yet."""
        self._set(True)

    def _set(self, is_found: bool) -> None:
        self._is_found = is_found
        self._checked_s = monotonic()


_LOOK_PERIOD_S = 0.5
# A publisher that is silent because its map does not change: the old one holds.
_UNCHANGED_S = 10.0
_AWAITED = 'scan that shows anything on local_grid of grid_mapper'


class _GridPublisher:
    """The mapper: whether there is one, and which map it publishes."""

    def __init__(self, node: ThinmapNode) -> None:
        self.followed = FollowedMap()
        self._node = node
        self._check = PublisherCheck(node, 'grid', 'local_grid')
        self.forget()
        node.diagnostics.add_check(WARN, self._silence)

    def forget(self) -> None:
        """A mapper that is silent is gone, and not dead."""
        self._stream = InputStream(
            'local_grid of grid_mapper', MAPPER_TIMEOUT_NS, MAPPER_TIMEOUT_NS
        )
        self._is_heard = False

    def is_found(self) -> bool:
        """Whether somebody publishes grids, or has done so: a mapper that was killed returns."""
        return self._is_heard or self._check.is_found()

    def received(self, message: ProbabilityGrid) -> None:
        """Reset the node where a grid is of another map than those before."""
        self._check.message_received()
        self._is_heard = True
        time = self._node.elapsed_time
        stamp_ns = messages.stamp_ns(message.header.stamp)
        self._stream.add(stamp_ns, time.now_ns(), time.age_ns(stamp_ns))
        if self.followed.origin(message.map_id) is Origin.OTHER:
            self._node.reset('grid is of another map')
            self.followed.origin(message.map_id)

    def _silence(self) -> str:
        fault = self._stream.fault(self._node.elapsed_time.now_ns())
        return f'{fault}: nothing to explore with' if fault else ''


class _TopologyPublisher:
    """The topology builder: whether there is one, and the last graph that it published."""

    def __init__(self, node: ThinmapNode) -> None:
        self.graph = Topology()
        self._map_id: int | None = None
        self._check = PublisherCheck(node, 'topology')

    def is_found(self) -> bool:
        """Whether somebody publishes topological maps."""
        return self._check.is_found()

    def received(self, message: TopologicalMap) -> None:
        """Follow a graph."""
        self._check.message_received()
        self._map_id = message.map_id
        self.graph = topology_from_msg(message)

    def is_awaited(self, map_id: int) -> bool:
        """Whether the graph of a map is still to come: none is here, or that of another map."""
        is_here = self._map_id is not None and (
            map_id == UNKNOWN or self._map_id in (UNKNOWN, map_id)
        )
        return not is_here and self.is_found()


class ObservationSource:
    """Makes observations of what is published.

    Where somebody publishes grid, each local grid is an observation with its scan. Else each new
    map is one, with the pose of TF.
    watchdog: notices inputs that are missing.
    """

    def __init__(
        self,
        node: ThinmapNode,
        settings: ExplorationSettings,
        map_frame: str,
        laser: LaserTransform,
        robot_radius_m: float,
        on_observation: Callable[[Observation], None],
    ) -> None:
        """on_observation: receives each observation; it is complete after `completed`."""
        self._node = node
        self._on_observation = on_observation
        self._graph_config = TopologyConfig(robot_radius_m=robot_radius_m)
        self._grids = _GridPublisher(node)
        self._topologies = _TopologyPublisher(node)
        self._view = RobotView(node, settings, map_frame, laser)
        self._map = ForeignMap(node, settings, map_frame, self._uses_foreign_map)
        self._keep_out = KeepOut()
        self.reset()
        subscribe_all(
            node,
            (TopologicalMap, 'topology', self._topologies.received, qos.LATCHED),
            (ProbabilityGrid, 'grid', self._on_grid, qos.LATCHED),
            (KeepOutMsg, 'keep_out', self._on_keep_out, qos.LATCHED),
            (LocalGrid, 'local_grid', self._on_local_grid, qos.LATCHED),
        )
        laser.subscribe(node, self._on_scan)
        node.create_active_timer(_LOOK_PERIOD_S, self._look)

    def reset(self) -> None:
        """Discard map and scans.

        Not the published graph: that of the next map may have come before its grid.
        """
        self._grids.followed = FollowedMap()
        self._grids.forget()
        self.watchdog = InputWatchdog()
        self._mapped = MapReceiver()
        self._graph = MapGraph(self._graph_config)
        self._view.reset()
        self._map.reset()
        self._looked_s = -_UNCHANGED_S

    def located(self, last: Observation | None) -> tuple[int, Array] | None:
        """Stamp and pose (3,) of the robot; None where it does not know its place.

        last: newest observation. In the map of another program, of now, by TF.
        """
        if self._uses_foreign_map():
            now_ns = self._node.now_ns
            try:
                return now_ns, self._view.newest_pose(now_ns)
            except InputError:
                return None
        silent_ns = SECOND_NS * (self._node.elapsed_time.now_s() - self.watchdog.last_scan_s)
        # A robot that was not localized for so long is somewhere else, perhaps.
        if last is None or self.watchdog.is_lost or silent_ns > POSE_TIMEOUT_NS:
            return None
        return last.scan.stamp_ns, last.T_map_base

    def completed(self, observation: Observation, is_joined: bool = False) -> Observation:
        """Observation with keep-out areas as walls, and with the graph of its map.

        The graph is found here if nobody publishes a topological map.
        is_joined: whether the map is more than the one whose graph is published.
        """
        patch = self._keep_out.laid_on(observation.patch, observation.T_map_base)
        return self._with_graph(observation, is_joined)._replace(patch=patch)

    def _with_graph(self, observation: Observation, is_joined: bool) -> Observation:
        if self._topologies.is_found() and not is_joined:
            return observation
        T_map_base = observation.T_map_base
        with self._node.diagnostics.time_step('graph of the map'):
            graph = self._graph.update(observation.patch, T_map_base, observation.scan.stamp_ns)
        return observation._replace(topology=graph)

    def _uses_foreign_map(self) -> bool:
        return not self._grids.is_found()

    # Inputs.

    def _on_grid(self, message: ProbabilityGrid) -> None:
        self._grids.received(message)
        self._mapped.replace(messages.grid_from_msg(message))

    def _on_local_grid(self, message: LocalGrid) -> None:
        self._grids.received(message.grid)
        now_s = self._node.elapsed_time.now_s()
        self.watchdog.add_tracking(messages.is_lost(message.localized.status), now_s)
        localized = localized_scan_from_msg(message.localized)
        self._mapped.paste(messages.grid_from_msg(message.grid))
        if localized.is_blind:
            return  # ignored: a blind scan observes nothing
        if self._is_graph_awaited():
            return
        self.watchdog.awaited = _AWAITED
        self.watchdog.add_scan(now_s)
        patch = self._mapped.patch
        if patch is not None:
            self._on_observation(
                Observation(self._topologies.graph, patch, localized.scan, localized.T_map_base)
            )

    def _on_keep_out(self, message: KeepOutMsg) -> None:
        self._keep_out = decode.keep_out(message)

    def _on_scan(self, topic: str, message: LaserScan) -> None:
        if self._uses_foreign_map():
            self._view.add_scan(topic, message)

    # Outputs.

    def _is_graph_awaited(self) -> bool:
        """Whether the graph of the map is still to come: without it, no end node has evidence."""
        is_awaited = self._topologies.is_awaited(self._grids.followed.id)
        if is_awaited:
            self.watchdog.awaited = 'topological map of this map on topology'
        return is_awaited

    def _look(self) -> None:
        """Make an observation of a new map; of an old one if there is none for a long time."""
        if not self._uses_foreign_map() or self._is_graph_awaited():
            return
        now_s = self._node.elapsed_time.now_s()
        is_due = not 0.0 <= now_s - self._looked_s < _UNCHANGED_S
        if not (self._map.is_changed or is_due):
            return
        try:
            observation = self._observe()
        except InputError as error:
            self.watchdog.awaited = f'pose of the robot in the map ({error})'
            return
        if observation is None:
            self.watchdog.awaited = f'map on {self._map.topic}'
            return
        self._looked_s = now_s
        self._map.is_changed = False
        self.watchdog.awaited = f'new map on {self._map.topic}'
        self.watchdog.add_scan(now_s)
        self._on_observation(observation)

    def _observe(self) -> Observation | None:
        patch = self._map.patch()
        if patch is None:
            return None
        now_ns = self._node.now_ns
        scan, T_map_base = self._view.look(patch, now_ns)
        return Observation(self._topologies.graph, patch, scan, T_map_base)
