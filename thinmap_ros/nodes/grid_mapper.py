"""The occupancy grid: each scan is added at the pose that the localizer found for it."""

from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid as OccupancyGridMsg
from nav_msgs.msg import Path
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.client import Client
from sensor_msgs.msg import LaserScan

from thinmap_msgs.srv import LoadMap, SaveMap
from thinmap_ros.core import snapshot
from thinmap_ros.core.errors import ThinmapError
from thinmap_ros.core.grid.correctable import CorrectableGrid
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid, WindowConfig
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stamp_matcher import StampMatcher
from thinmap_ros.files import sessions
from thinmap_ros.kernels import warm_up
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.checkpoint import State
from thinmap_ros.ros.laser_transform import LaserMount
from thinmap_ros.ros.lifecycle_node import LiveNode
from thinmap_ros.ros.save_folder import SaveFolder
from thinmap_ros.ros.services import answer, ask
from thinmap_ros.ros.subscription import listen

_LOST_SIGMA_M = 200.0  # a pose that is not known better than this is that of a lost robot
_NO_BUILDER = 'no graph: there is no topology_builder'


class GridMapperNode(LiveNode):
    """/scan and /pose in; /map once a second and /local_map at every scan out.

    Services save_map and load_map.

    After a /trajectory the map is re-rendered, a slice with each scan, near tiles first; meanwhile
    tiles that are not complete are shown as they were. map_load_time of both is the stamp of the
    newest trajectory that all of the map follows.
    """

    def __init__(self) -> None:
        super().__init__('grid_mapper', recovers=True)
        self._config = parameters.declare(self, OccupancyConfig)
        self._window_m = parameters.declare(self, WindowConfig).window_m
        self._mapping = parameters.declare_value(
            self, 'mapping', True, 'draw what is seen; false: the map stays'
        )
        self._map_frame = parameters.declare_value(self, 'map_frame', 'map', 'frame of the map')
        self._mount = LaserMount(self)
        self._session = parameters.declare_session(self)
        self._saves = SaveFolder(self)
        parameters.check_unknown(self)
        warm_up.grid_mapper()
        self._latest_ns: int | None = None
        self._map = self.create_publisher(OccupancyGridMsg, 'map', qos.LATCHED)
        self._local_map = self.create_publisher(OccupancyGridMsg, 'local_map', qos.LATCHED)
        self._resumed_ns: int | None = None
        self._taken_over_ns = 0
        self.begin_anew()
        self.keep(self._state, self._resume)
        self.offer_pause()
        self.health.sole_publisher_of('map')
        # First: of messages that wait together it is taken before the poses that follow from it.
        listen(self, Path, 'trajectory', self._on_trajectory, qos.LATCHED)
        listen(self, PoseWithCovarianceStamped, 'pose', self._on_pose, qos.STREAM)
        listen(self, LaserScan, 'scan', self._on_scan, qos.SENSOR)
        # Mapping goes on while a map is saved, and waits while one is loaded: nothing gets into the
        # wrong graph.
        aside = ReentrantCallbackGroup()
        self.create_service(SaveMap, 'save_map', self._on_save, callback_group=aside)
        self.create_service(LoadMap, 'load_map', self._on_load)
        self._save_topology = self.create_client(SaveMap, 'save_topology', callback_group=aside)
        self._save_exploration = self.create_client(
            SaveMap, 'save_exploration', callback_group=aside
        )
        self._save_features = self.create_client(SaveMap, 'save_features', callback_group=aside)
        self._load_features = self.create_client(LoadMap, 'load_features', callback_group=aside)
        self._load_topology = self.create_client(LoadMap, 'load_topology', callback_group=aside)
        self.every(1.0, self._publish_map)

    def begin_anew(self) -> None:
        """Forget the map, or go back to the session that the node was started with."""
        self._matcher: StampMatcher[LaserScan, tuple[Array, bool]] = StampMatcher()
        known = self._session or self._latest_ns is not None
        self._latest_ns = None
        if self._session:
            self._grid = CorrectableGrid(self._of_session(), keeps_scans=False)
        else:
            self._grid = CorrectableGrid(OccupancyGrid(self._config))
        if known:
            self._latest_ns = self.get_clock().now().nanoseconds
            self._publish_map()

    def _state(self) -> State | None:
        if self._latest_ns is None:
            return None
        return {**self._grid.shown.state(), 'latest_ns': np.array(self._latest_ns)}

    def _resume(self, left: State) -> None:
        """Take over the map of a killed mapper. Raises InputError where it is no such map."""
        latest_ns, cells = snapshot.split_stamp(left)
        grid = OccupancyGrid.from_state(cells, self._config)
        self._resumed_ns = self._latest_ns = self._taken_over_ns = latest_ns
        self._replace_map(grid)

    def _of_session(self) -> OccupancyGrid:
        return sessions.load_grid(self._session, self._config)

    def _on_scan(self, message: LaserScan) -> None:
        self._add_scan(self._matcher.add_left(messages.stamp_ns(message.header.stamp), message))

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        is_known = bool(messages.covariance_from(message)[0, 0] < _LOST_SIGMA_M**2)
        T_map_base = messages.pose_from(message.pose.pose)
        self._add_scan(
            self._matcher.add_right(messages.stamp_ns(message.header.stamp), (T_map_base, is_known))
        )

    def _add_scan(self, pair: tuple[LaserScan, tuple[Array, bool]] | None) -> None:
        self.health.dropped_in_all('scans and poses without a partner', self._matcher.dropped)
        if pair is None:
            return
        message, (T_map_base, is_known) = pair
        scan = self._mount.scan(message)
        if self._resumed_ns is not None and scan.stamp_ns < self._resumed_ns:
            self.begin_anew()  # the robot has begun anew as well
        self._resumed_ns = None
        with self.health.timed('map update'):
            is_mapped = self._mapping and is_known
            moved = self._grid.update(scan if is_mapped else None, T_map_base)
            window = self._grid.shown.window(T_map_base[0], T_map_base[1], self._window_m)
        self._latest_ns = scan.stamp_ns
        if moved is not None:
            self._publish_map()  # before the windows of the corrected map
        self._local_map.publish(
            messages.grid_msg(window, self._map_frame, scan.stamp_ns, self._grid.corrected_ns)
        )

    def _publish_map(self) -> None:
        if self._latest_ns is not None:
            patch = self._grid.shown.known_area()
            corrected_ns = self._grid.corrected_ns
            self._map.publish(
                messages.grid_msg(patch, self._map_frame, self._latest_ns, corrected_ns)
            )

    def _on_trajectory(self, message: Path) -> None:
        """A loop was closed: correct where the scans of the map were made."""
        corrected_ns = messages.stamp_ns(message.header.stamp)
        if self._latest_ns is None or corrected_ns <= self._taken_over_ns:
            # Latched, and older than the map: that has undergone it, or is a new one.
            self._grid.corrected_ns = corrected_ns
            return
        with self.health.timed('map correction'):
            stamps_ns, poses = messages.trajectory_from(message)
            is_followed = self._grid.apply_correction(stamps_ns, poses, since_ns=corrected_ns)
        if not is_followed:
            self.get_logger().warning(
                'a loop is closed, but the map was loaded, not drawn here: it stays as it was'
            )
            self._publish_map()

    def _replace_map(self, grid: OccupancyGrid) -> None:
        corrected_ns = self._grid.corrected_ns
        self._grid = CorrectableGrid(grid, keeps_scans=False, corrected_ns=corrected_ns)
        self._latest_ns = self._latest_ns or self.get_clock().now().nanoseconds
        self._publish_map()

    def _save_grid(self, path: str) -> str:
        """Save the map, after all of it has undergone the newest correction."""
        if self._grid.finish() is not None:
            self._publish_map()
        return f'saved {sessions.save_grid(path, self._grid.shown)}'

    async def _on_save(
        self, request: SaveMap.Request, response: SaveMap.Response
    ) -> SaveMap.Response:
        answer(response, lambda: self._save_grid(self._saves.inside(request.path)))
        if not response.success:
            return response
        path = str(sessions.stem_of(self._saves.inside(request.path)))
        graph = await ask(self, self._save_topology, SaveMap.Request(path=path))
        if graph is None:
            saved = response.message
            answer(response, lambda: f'{saved}; {_NO_BUILDER}{sessions.set_topology_aside(path)}')
        else:
            response.success = graph.success
            response.message = f'{response.message}; {graph.message}'
        await self._save_at(self._save_features, path, sessions.set_features_aside, response)
        await self._save_at(self._save_exploration, path, sessions.set_exploration_aside, response)
        return response

    async def _save_at(
        self, client: Client, path: str, set_aside: Callable[[str], str], response: SaveMap.Response
    ) -> None:
        """Have another node save its part.

        Without that node, what is there of an earlier map must not pass for this one's.
        """
        saved = response.message
        part = await ask(self, client, SaveMap.Request(path=path))
        if part is not None:
            response.success = response.success and part.success
            response.message = f'{saved}; {part.message}'
        elif response.success:
            answer(response, lambda: f'{saved}{set_aside(path)}')

    async def _on_load(
        self, request: LoadMap.Request, response: LoadMap.Response
    ) -> LoadMap.Response:
        """Take over grid and graph, or neither."""
        try:
            inside = self._saves.inside(request.path)
            grid = sessions.load_grid(inside, self._config, self._saves.path)
            stem = str(sessions.stem_of(inside))
            path = stem if sessions.has_topology(stem) else ''
        except ThinmapError as error:
            response.success = False
            response.message = str(error)
            return response
        graph = await ask(self, self._load_topology, LoadMap.Request(path=path))
        response.success = graph is None or graph.success
        response.message = _NO_BUILDER if graph is None else graph.message
        if response.success:
            self._replace_map(grid)
            response.message = f'grid taken over; {response.message}'
            features = await ask(self, self._load_features, LoadMap.Request(path=stem))
            if features is not None:
                response.success = features.success
                response.message = f'{response.message}; {features.message}'
        return response


def main() -> None:
    """Run the node."""
    node_main.run(GridMapperNode)


if __name__ == '__main__':
    main()
