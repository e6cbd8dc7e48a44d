"""The occupancy grid: each scan drawn in at the pose that the localizer found for it."""

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid as OccupancyGridMsg
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

from thinmap_msgs.srv import LoadMap, SaveMap
from thinmap_ros import warm_up
from thinmap_ros.adapters import messages, parameters, qos, runtime, session_files
from thinmap_ros.adapters.listening import listen
from thinmap_ros.adapters.services import answer, ask
from thinmap_ros.adapters.stamps import StampMatcher
from thinmap_ros.adapters.transforms import LaserMount
from thinmap_ros.core.errors import ThinmapError
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid, WindowConfig
from thinmap_ros.core.se2 import Array

_NO_BUILDER = 'no graph: there is no topology_builder'


class GridMapperNode(Node):
    """/scan and /pose in; /map once a second and /local_map at every scan out; services save_map and load_map."""

    def __init__(self) -> None:
        super().__init__('grid_mapper')
        self._config = parameters.declare(self, OccupancyConfig)
        self._window_m = parameters.declare(self, WindowConfig).window_m
        self._map_frame = parameters.declare_value(self, 'map_frame', 'map', 'frame of the map')
        self._mount = LaserMount(self)
        session = parameters.declare_session(self)
        parameters.check_unknown(self)
        self._grid = session_files.load_grid(session, self._config) if session else OccupancyGrid(self._config)
        warm_up.grid_mapper()
        self._matcher: StampMatcher[LaserScan, Array] = StampMatcher()
        self._latest_ns: int | None = None
        self._map = self.create_publisher(OccupancyGridMsg, 'map', qos.LATCHED)
        self._local_map = self.create_publisher(OccupancyGridMsg, 'local_map', qos.LATCHED)
        listen(self, PoseWithCovarianceStamped, 'pose', self._on_pose, qos.STREAM)
        listen(self, LaserScan, 'scan', self._on_scan, qos.SENSOR)
        # Mapping goes on while a map is saved, and waits while one is loaded: nothing gets into the wrong graph.
        aside = ReentrantCallbackGroup()
        self.create_service(SaveMap, 'save_map', self._on_save, callback_group=aside)
        self.create_service(LoadMap, 'load_map', self._on_load)
        self._save_topology = self.create_client(SaveMap, 'save_topology', callback_group=aside)
        self._save_exploration = self.create_client(SaveMap, 'save_exploration', callback_group=aside)
        self._load_topology = self.create_client(LoadMap, 'load_topology', callback_group=aside)
        self.create_timer(1.0, self._publish_map)
        if session:
            self._take_over(self._grid)

    def _on_scan(self, message: LaserScan) -> None:
        self._take(self._matcher.left(messages.stamp_ns(message.header.stamp), message))

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        T_map_base = messages.pose_from(message.pose.pose)
        self._take(self._matcher.right(messages.stamp_ns(message.header.stamp), T_map_base))

    def _take(self, pair: tuple[LaserScan, Array] | None) -> None:
        if pair is None:
            return
        message, T_map_base = pair
        T_base_laser = self._mount.pose(message.header.frame_id)
        if T_base_laser is None:
            return  # the localizer, which gave the pose, knows where the laser is: the transform is on its way
        scan = messages.scan_from(message, T_base_laser)
        self._grid.update(scan, T_map_base)
        self._latest_ns = scan.stamp_ns
        window = self._grid.window(T_map_base[0], T_map_base[1], self._window_m)
        self._local_map.publish(messages.grid_msg(window, self._map_frame, scan.stamp_ns))

    def _publish_map(self) -> None:
        if self._latest_ns is not None:
            self._map.publish(messages.grid_msg(self._grid.patch(), self._map_frame, self._latest_ns))

    def _take_over(self, grid: OccupancyGrid) -> None:
        self._grid, self._latest_ns = grid, self._latest_ns or self.get_clock().now().nanoseconds
        self._publish_map()

    async def _on_save(self, request: SaveMap.Request, response: SaveMap.Response) -> SaveMap.Response:
        answer(response, lambda: f'saved {session_files.save_grid(request.path, self._grid)}')
        if not response.success:
            return response
        path = str(session_files.stem_of(request.path))
        graph = await ask(self, self._save_topology, SaveMap.Request(path=path))
        if graph is None:
            saved = response.message
            answer(response, lambda: f'{saved}; {_NO_BUILDER}{session_files.set_topology_aside(path)}')
            return await self._save_what_was_learned(path, response)
        response.success, response.message = graph.success, f'{response.message}; {graph.message}'
        return await self._save_what_was_learned(path, response)

    async def _save_what_was_learned(self, path: str, response: SaveMap.Response) -> SaveMap.Response:
        saved, learned = response.message, await ask(self, self._save_exploration, SaveMap.Request(path=path))
        if learned is not None:
            response.success, response.message = response.success and learned.success, f'{saved}; {learned.message}'
            return response
        # Without an explorer, what one has learned of an earlier map must not be taken for this one's.
        if response.success:
            answer(response, lambda: f'{saved}{session_files.set_exploration_aside(path)}')
        return response

    async def _on_load(self, request: LoadMap.Request, response: LoadMap.Response) -> LoadMap.Response:
        """Take over grid and graph, or neither."""
        try:
            grid = session_files.load_grid(request.path, self._config)
            path = str(session_files.stem_of(request.path)) if session_files.has_topology(request.path) else ''
        except ThinmapError as error:
            response.success, response.message = False, str(error)
            return response
        graph = await ask(self, self._load_topology, LoadMap.Request(path=path))
        response.success = graph is None or graph.success
        response.message = _NO_BUILDER if graph is None else graph.message
        if response.success:
            self._take_over(grid)
            response.message = f'grid taken over; {response.message}'
        return response


def main() -> None:
    """Run the node."""
    runtime.run(GridMapperNode)


if __name__ == '__main__':
    main()
