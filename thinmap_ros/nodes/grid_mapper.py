"""The occupancy grid: each scan is added at the pose that the localizer found for it."""

import pathlib
from dataclasses import dataclass, replace

import numpy as np
from nav_msgs.msg import Path
from nav_msgs.srv import GetMap
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.timer import Timer

from thinmap_msgs.msg import LocalizedScan as LocalizedScanMsg
from thinmap_msgs.msg import SlamStatus
from thinmap_msgs.srv import LoadMap, SaveMap
from thinmap_ros import kernels
from thinmap_ros.core import snapshot
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ThinmapError
from thinmap_ros.core.grid.correction import CorrectableGrid
from thinmap_ros.core.grid.edits import KeepOut
from thinmap_ros.core.grid.mapper import Mapper
from thinmap_ros.core.grid.occupancy import OccupancyConfig, WindowConfig
from thinmap_ros.core.snapshot import State
from thinmap_ros.core.stage import LOCALIZATION, MAPPING, Destination, Trajectory
from thinmap_ros.files import sessions
from thinmap_ros.nodes.parts.mapping import (
    MapEditing,
    MapOutputConfig,
    MapPublishers,
    ScanQueue,
    TeamInScans,
)
from thinmap_ros.ros import node_main, parameters, qos
from thinmap_ros.ros.checkpoint import StateStamp
from thinmap_ros.ros.diagnostics import ERROR
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.localized_scan import ReceivedScan, localized_scan_from_msg
from thinmap_ros.ros.maps import FollowedMap, Origin
from thinmap_ros.ros.services import fill_response
from thinmap_ros.ros.session_services import SaveDirectory, SessionClient, joined, save_on_exit
from thinmap_ros.ros.subscription import WARN_PERIOD_S, subscribe_all

_OTHER_MAP = (
    'the localizer is in another map than the one here: scans are not mapped: expected that it '
    'finds its place in this map, or ~/reset of this node'
)


@dataclass(frozen=True)
class ModeConfig(Config):
    """Whether scans change the map."""

    mode: str = parameter(
        MAPPING,
        'mapping: scans extend and change the map. localization: the map is published and does '
        'not change.',
        choices=(MAPPING, LOCALIZATION),
    )


class GridMapperNode(ThinmapNode):
    """/localized_scan in; /map, /grid, /local_grid and /keep_out out.

    /local_grid follows every scan, and holds it. /map and /grid are published when they have
    changed: once in map_update_interval, and at once after a reset, a load and a correction. As
    long as every node that subscribes to /map also subscribes to /map_updates, /map is sent only
    where its size, origin or identity changes, when a subscriber comes, and 10 intervals after an
    update; where it has more than 400 kB, later, so that this is at most 40 kB/s.

    Services save_map, load_map; map and dynamic_map return the present map. add_keep_out and
    remove_keep_out edit areas in which no robot is to drive, load_keep_out adds those of a mask for
    Nav2; erase_area sets cells to unknown.
    /keepout_filter_mask and /costmap_filter_info are for Nav2's keepout filter.

    After a /trajectory the map is re-rendered, a slice with each scan, near tiles first; meanwhile
    tiles that are not complete are shown as they were. correction_stamp of grid and local_grid is
    the stamp of the newest trajectory that all of the map follows.

    With team: true the robots of /team/claims that are joined by /join_status are cut out of scans:
    once they are, also of the earlier ones.
    """

    def __init__(self) -> None:
        super().__init__('grid_mapper', recovers=True)
        self._grid_config = parameters.declare_config(self, OccupancyConfig)
        output = parameters.declare_config(self, MapOutputConfig, self._on_output)
        window_m = parameters.declare_config(self, WindowConfig).local_map_size_m
        self._is_mapping = parameters.declare_config(self, ModeConfig).mode == MAPPING
        self._output = MapPublishers(self, output)
        self._team = TeamInScans(self)
        self._session = parameters.declare_session(self)
        self._save_directory = SaveDirectory(self)
        save_on_exit(self, self._save_directory, sessions.GRID, self._save_at_end)
        parameters.reject_unknown(self)
        kernels.grid_mapper()
        self._stamp = StateStamp()
        self._mapper = Mapper(self._grid_config, window_m=window_m)
        self._editing = MapEditing(
            self,
            self._output.frame_id,
            self._save_directory,
            self._mapper,
            lambda: self._stamp.latest_ns,
            self._publish_map,
        )
        self.reset_state()
        self.enable_checkpoint(self._state, self._restore)
        self.create_pause_service()
        self.diagnostics.check_sole_publisher('map')
        self.diagnostics.add_check(ERROR, lambda: self._fault)
        subscribe_all(
            self,
            (Path, 'trajectory', self._on_trajectory, qos.LATCHED),
            (LocalizedScanMsg, 'localized_scan', self._on_scan, qos.STREAM),
        )
        # Mapping continues while a map is saved, and waits while one is loaded: no window of the
        # old map reaches the new graph.
        reentrant = ReentrantCallbackGroup()
        self._session_client = SessionClient(self, reentrant)
        self.create_active_service(SaveMap, 'save_map', self._on_save, callback_group=reentrant)
        self.create_service(LoadMap, 'load_map', self._on_load)
        for name in ('map', 'dynamic_map'):
            self.create_active_service(GetMap, name, self._on_get_map)
        self._map_timer = self._create_map_timer()

    def _create_map_timer(self) -> Timer:
        return self.create_active_timer(self._output.config.map_update_interval, self._publish_map)

    def _on_output(self, config: MapOutputConfig) -> None:
        """Publish the map with other values or at another rate, the first at once."""
        self._output.config = config
        self.destroy_timer(self._map_timer)
        self._map_timer = self._create_map_timer()
        if self.is_active:
            self._publish_map()

    def reset_state(self) -> None:
        """Discard the map, or return to the session that the node was started with."""
        self._scans = ScanQueue()
        self._fault = ''
        self._output.followed = FollowedMap()
        self._output.load_ns = self.now_ns
        has_map = self._session or self._stamp.latest_ns is not None
        self._stamp.latest_ns = None
        self._mapper.reset()
        if self._session:
            self._mapper.replace(*self._load_map(self._session))
            patch = self._mapper.grid.shown.known_area()
            free_m2 = np.count_nonzero(patch.free) * patch.frame.resolution**2
            self.get_logger().info(f'loaded {self._session}: {free_m2:.0f} m2 free')
        if has_map:
            self._stamp.latest_ns = self.now_ns
        self._publish_map()

    def _load_map(
        self, path: str, folder: pathlib.Path | None = None
    ) -> tuple[CorrectableGrid, KeepOut]:
        """The map of a session, or any map_server map; corrected if the session has keyframes."""
        report = self.get_logger().warning
        return sessions.load_map(path, self._grid_config, self._is_mapping, folder, report)

    def _state(self) -> State | None:
        if self._stamp.latest_ns is None:
            return None
        return {
            **self._mapper.state(),
            'latest_ns': np.array(self._stamp.latest_ns),
            'map_id': np.array(self._output.followed.id),
        }

    def _restore(self, state: State) -> None:
        """Continue with the map of a killed mapper. Raises InputError where it is no such map."""
        latest_ns, rest = snapshot.split_number(state, 'latest_ns')
        map_id, cells = snapshot.split_number(rest, 'map_id')
        self._mapper.restore(cells)
        self._stamp.restore(latest_ns)
        self._map_replaced()
        self._output.followed = FollowedMap(map_id)

    def _on_scan(self, message: LocalizedScanMsg) -> None:
        self._scans.add_scan(localized_scan_from_msg(message))
        self._add_scans()

    def _on_trajectory(self, message: Path) -> None:
        self._scans.add_trajectory(message)
        self._add_scans()

    def _add_scans(self) -> None:
        for localized in self._scans.ready():
            if localized.trajectory is not None:
                self._correct(localized.trajectory)
            self._add_scan(localized)
        self.diagnostics.set_drop_total('scans without their trajectory', self._scans.dropped)

    def _add_scan(self, localized: ReceivedScan) -> None:
        if not self._is_of_this_map(localized.message.status):
            return
        stamp_ns = localized.scan.stamp_ns
        if self._stamp.is_restarted_by(stamp_ns):
            self.reset_state()
        destination = localized.destination if self._is_mapping else Destination.NOWHERE
        with self.diagnostics.time_step('map update'):
            self._mapper.grid.place_mates(self._team.places)
            scan = self._team.noted(localized.scan)
            update = self._mapper.step(
                replace(localized, scan=scan, destination=destination, trajectory=None)
            )
        self._stamp.latest_ns = stamp_ns
        if update is not None and update.whole is not None:
            self._publish_map()  # before the windows of the corrected map
        if update is not None:
            self._output.publish_local_grid(update, localized)
        for refusal in self._mapper.refusals:
            self.diagnostics.message_rejected('localized_scan', refusal)
            self.get_logger().warning(
                f'localized_scan: {refusal}', throttle_duration_sec=WARN_PERIOD_S
            )

    def _is_of_this_map(self, status: SlamStatus) -> bool:
        """Whether a scan was localized in the map of this node, which follows its localizer's."""
        followed = self._output.followed
        origin = followed.origin(status.map_id)
        if origin is Origin.OTHER and status.replaced_map_id == followed.id:
            self.reset('the localizer was reset')
            origin = followed.origin(status.map_id)
        is_other = origin is Origin.OTHER
        self._fault = _OTHER_MAP if is_other and self._is_mapping else ''
        if self._fault:
            self.get_logger().warning(self._fault, throttle_duration_sec=WARN_PERIOD_S)
        return not self._fault and origin is not Origin.STALE

    def _publish_map(self) -> None:
        self._editing.publish()
        if self._stamp.latest_ns is not None:
            self._output.publish_map(self._mapper.whole_map(), self._stamp.latest_ns)

    def _on_get_map(self, _: GetMap.Request, response: GetMap.Response) -> GetMap.Response:
        stamp_ns = self._stamp.latest_ns or self.now_ns
        response.map = self._output.map_message(self._mapper.whole_map().patch, stamp_ns)
        return response

    def _correct(self, trajectory: Trajectory) -> None:
        """A loop was closed: correct the poses at which the scans of the map were made."""
        if not self._stamp.is_corrected_by(trajectory.since_ns):
            # A latched trajectory from before this map, which follows it or is a new one.
            self._mapper.grid.corrected_ns = trajectory.since_ns
            return
        with self.diagnostics.time_step('map correction'):
            is_corrected = self._mapper.correct(trajectory)
        if not is_corrected:
            self.get_logger().warning(
                'loop closed, but a map that was loaded without keyframes is not corrected'
            )
            self._publish_map()

    def _map_replaced(self) -> None:
        self._output.followed.leave()
        self._output.load_ns = self.now_ns
        self._stamp.latest_ns = self._stamp.latest_ns or self._output.load_ns
        self._publish_map()

    def _load(self, grid: CorrectableGrid, keep_out: KeepOut) -> None:
        grid.corrected_ns = self._mapper.grid.corrected_ns
        self._mapper.replace(grid, keep_out)
        self._map_replaced()

    def _save_grid(self, path: str, overwrite: bool = False) -> str:
        """Save the map, after all of it follows the newest correction."""
        if self._mapper.finish() is not None:
            self._publish_map()
        shown = self._output.config.trinary(self._mapper.whole_map().patch)
        grid = self._mapper.grid.shown
        return f'saved {sessions.save_grid(path, grid, shown, self._mapper.edits, overwrite)}'

    def _save_at_end(self, path: str) -> str:
        is_changed = self._is_mapping or self._editing.is_edited
        has_map = is_changed and self._stamp.latest_ns is not None
        return self._save_grid(path) if has_map else ''

    async def _on_save(
        self, request: SaveMap.Request, response: SaveMap.Response
    ) -> SaveMap.Response:
        folder = self._save_directory
        fill_response(
            response,
            lambda: self._save_grid(
                folder.resolve_for_saving(request.path, sessions.GRID), request.overwrite
            ),
        )
        if response.success:
            others = await self._session_client.save(
                folder.resolve(request.path), request.overwrite
            )
            return joined(response, others)
        return response

    async def _on_load(self, request: LoadMap.Request, _: LoadMap.Response) -> LoadMap.Response:
        """Load grid and graph, or neither."""
        try:
            path = self._save_directory.resolve(request.path)
            loaded = self._load_map(path, self._save_directory.path)
            return await self._session_client.load(path, lambda: self._load(*loaded))
        except ThinmapError as error:
            return LoadMap.Response(success=False, message=str(error))


main = node_main.program(GridMapperNode)

if __name__ == '__main__':
    main()
