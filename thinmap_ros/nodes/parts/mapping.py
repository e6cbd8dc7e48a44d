"""Parts of the grid mapper: scans in, edits, and the map on topics."""

from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from map_msgs.msg import OccupancyGridUpdate
from nav2_msgs.msg import CostmapFilterInfo
from nav_msgs.msg import MapMetaData, OccupancyGrid, Path
from rclpy.event_handler import PublisherEventCallbacks, QoSPublisherMatchedInfo
from rclpy.node import Node

from thinmap_msgs.msg import KeepOut as KeepOutMsg
from thinmap_msgs.msg import KeepOutArea as KeepOutAreaMsg
from thinmap_msgs.msg import LocalGrid, ProbabilityGrid
from thinmap_msgs.srv import AddKeepOut, EraseArea, LoadMap, RemoveKeepOut
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError, InputError, counted
from thinmap_ros.core.grid.edits import KeepOut
from thinmap_ros.core.grid.mapper import Mapper, MapUpdate, WholeMap
from thinmap_ros.core.grid.patch import Bounds, GridFrame, GridPatch, Margins
from thinmap_ros.core.scan import NearbyRobot, Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stage import Trajectory
from thinmap_ros.files.keep_out_masks import outlines_of, read_mask
from thinmap_ros.logs import decode
from thinmap_ros.ros import diagnostics, messages, parameters, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.localized_scan import ReceivedScan
from thinmap_ros.ros.maps import FollowedMap, updates_topic
from thinmap_ros.ros.services import fill_response, offer
from thinmap_ros.ros.session_services import SaveDirectory
from thinmap_ros.ros.team import heard_robots

_FREE = np.int8(0)
_FORBIDDEN = np.int8(100)
_KEEPOUT_FILTER = 0  # type of Nav2's filter


class MapEditing:
    """Services add_keep_out, load_keep_out, remove_keep_out and erase_area; publishes keep_out.

    keepout_filter_mask and costmap_filter_info are those of Nav2's keepout filter.
    is_edited: whether anything was edited since the node was started.
    """

    def __init__(
        self,
        node: ThinmapNode,
        frame_id: str,
        directory: SaveDirectory,
        mapper: Mapper,
        latest_ns: Callable[[], int | None],
        on_erased: Callable[[], None],
    ) -> None:
        """frame_id: of the map; directory: of masks that are loaded.

        latest_ns: stamp of the newest scan in the map, None without a map. on_erased: is called
        when cells have become unknown.
        """
        self.is_edited = False
        self._node = node
        self._frame_id = frame_id
        self._directory = directory
        self._mapper = mapper
        self._latest_ns = latest_ns
        self._on_erased = on_erased
        self._published: tuple[KeepOut, GridFrame] | None = None
        self._areas = node.create_publisher(KeepOutMsg, 'keep_out', qos.LATCHED)
        self._mask = node.create_publisher(OccupancyGrid, 'keepout_filter_mask', qos.LATCHED)
        self._info = node.create_publisher(CostmapFilterInfo, 'costmap_filter_info', qos.LATCHED)
        node.create_active_service(AddKeepOut, 'add_keep_out', self._on_add)
        offer(node.create_active_service, LoadMap, 'load_keep_out', self._on_load)
        offer(node.create_active_service, RemoveKeepOut, 'remove_keep_out', self._on_remove)
        offer(node.create_active_service, EraseArea, 'erase_area', self._on_erase)

    def publish(self) -> None:
        """Publish the areas and their mask, if they have changed."""
        keep_out = self._mapper.keep_out
        frame = self._mapper.grid.shown.frame
        if self._published is None:
            self._info.publish(
                CostmapFilterInfo(
                    header=self._header(),
                    type=_KEEPOUT_FILTER,
                    filter_mask_topic=self._mask.topic_name,
                    base=0.0,
                    multiplier=1.0,
                )
            )
        elif self._published == (keep_out, frame):
            return
        self._published = (keep_out, frame)
        areas = [
            KeepOutAreaMsg(
                id=area.id,
                is_wall=area.is_wall,
                corners=messages.polygon_msg(area.corners.tolist()),
            )
            for area in keep_out.areas
        ]
        self._areas.publish(KeepOutMsg(header=self._header(), areas=areas))
        try:
            mask = mask_of(keep_out, frame)
        except InputError as error:  # of a session with other cells
            self._node.get_logger().warning(f'keepout_filter_mask: {error}')
            return
        self._mask.publish(messages.grid_msg(mask, self._frame_id, self._node.now_ns))

    def _header(self) -> Any:
        return messages.header(self._frame_id, self._node.now_ns)

    def _replace(self, keep_out: KeepOut) -> None:
        self._mapper.keep_out = keep_out
        self.is_edited = True
        self.publish()

    def _on_add(
        self, request: AddKeepOut.Request, response: AddKeepOut.Response
    ) -> AddKeepOut.Response:
        def add() -> str:
            corners = decode.corners(request.corners)
            keep_out = self._mapper.keep_out.with_area(corners, bool(request.is_wall))
            keep_out.bounds(self._mapper.grid.shown.frame)  # raises for a mask that is too large
            self._replace(keep_out)
            added = keep_out.areas[-1]
            response.id = added.id
            return f'{added} added'

        return fill_response(response, add)

    def _on_load(self, request: LoadMap.Request) -> str:
        patch = self._mapper.grid.shown.known_area()
        directory = self._directory
        mask = read_mask(directory.resolve(request.path), patch, directory.path)
        keep_out = self._mapper.keep_out
        before = len(keep_out.areas)
        for corners in outlines_of(mask, patch):
            keep_out = keep_out.with_area(corners, is_wall=False)
        keep_out.bounds(patch.frame)  # raises for a mask that is too large
        self._replace(keep_out)
        return f'{counted(len(keep_out.areas) - before, "keep-out area")} added'

    def _on_remove(self, request: RemoveKeepOut.Request) -> str:
        before = len(self._mapper.keep_out.areas)
        self._replace(self._mapper.keep_out.without(request.id))
        removed = before - len(self._mapper.keep_out.areas)
        return f'{counted(removed, "keep-out area")} removed'

    def _on_erase(self, request: EraseArea.Request) -> str:
        latest_ns = self._latest_ns()
        if latest_ns is None:
            raise InputError('no map yet: expected a scan that is mapped')
        self._mapper.erase(decode.corners(request.corners), latest_ns)
        self.is_edited = True
        self._on_erased()
        return 'the cells are unknown until the laser shows them again'


def mask_of(keep_out: KeepOut, frame: GridFrame) -> GridPatch:
    """Mask on the cells of a map: 100 in the areas, 0 beside them; one cell of 0 without areas.

    Raises InputError where it would be too large.
    """
    row, col, end_row, end_col = keep_out.bounds(frame) or (0, 0, 1, 1)
    at = frame.with_origin_at(row, col)
    cells = keep_out.cells(at, (end_row - row, end_col - col))
    return GridPatch(at, np.where(cells, _FORBIDDEN, _FREE))


TRINARY = 'trinary'
PROBABILITY = 'probability'


@dataclass(frozen=True)
class MapOutputConfig(Config):
    """How the topic map is published."""

    map_values: str = parameter(
        TRINARY,
        'Values of map. trinary: -1 unknown, 0 free, 100 occupied, as slam_toolbox and map_server '
        'publish them. probability: -1 or the probability of occupancy (%).',
        choices=(TRINARY, PROBABILITY),
    )
    occupied_thresh: float = parameter(
        0.65,
        'Probability from which a cell of a trinary map is occupied. Raise it against walls that '
        'people leave behind, lower it for thin obstacles.',
        low=0.0,
        high=1.0,
    )
    free_thresh: float = parameter(
        0.25,
        'Probability up to which a cell of a trinary map is free. Lower it to show only cells as '
        'free that many beams have crossed.',
        low=0.0,
        high=1.0,
    )
    map_update_interval: float = parameter(
        1.0,
        'Least time between two messages of map or map_updates (s). Raise it to save CPU and '
        'network traffic with large maps.',
        low=0.05,
        high=3600.0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.free_thresh < self.occupied_thresh:
            expected = f'expected less than occupied_thresh ({self.occupied_thresh})'
            raise ConfigError(f'free_thresh = {self.free_thresh}: {expected}')

    def shown(self, patch: GridPatch) -> GridPatch:
        """The patch with the values to publish."""
        return patch if self.map_values == PROBABILITY else self.trinary(patch)

    def trinary(self, patch: GridPatch) -> GridPatch:
        """The patch with -1, 0 and 100, in whole percent as map_saver compares them."""
        limits = (round(100.0 * self.free_thresh), round(100.0 * self.occupied_thresh))
        return GridPatch(patch.frame, patch.trinary(*limits))


@dataclass(frozen=True)
class MapIdentity:
    """Which map it is, and how it is shown; load_ns, corrected_ns, map_id: as in the messages."""

    load_ns: int
    corrected_ns: int
    map_id: int
    config: MapOutputConfig


@dataclass(frozen=True, eq=False)
class MapVersion:
    """All known cells of the map, in percent, and the stamp of the last scan in it."""

    identity: MapIdentity
    patch: GridPatch
    stamp_ns: int

    def extends(self, before: 'MapVersion') -> bool:
        """Whether it is the same map as before, and covers all that was known then."""
        if self.identity != before.identity or not self.patch.is_aligned_with(before.patch):
            return False
        return not any(self.patch.overhang_of(before.patch))

    def changes_since(self, before: 'MapVersion | None') -> Bounds | None:
        """Bounds of all cells that differ from a version before; None: nothing differs."""
        is_same_rectangle = (
            before is not None
            and self.identity == before.identity
            and self.patch.frame == before.patch.frame
            and self.patch.shape == before.patch.shape
        )
        if before is None or not is_same_rectangle:
            return (0, 0, *self.patch.shape)
        if self.patch is before.patch:
            return None
        return self.patch.changes_since(before.patch)

    def shown(self, bounds: Bounds | None = None) -> GridPatch:
        """The cells within bounds, or all, with the values to publish."""
        part = self.patch if bounds is None else self.patch.part(bounds)
        return self.identity.config.shown(part)


# Calls after which a whole map follows an update: one that was lost, for a reason that no
# publisher knows, is missing for so long. That of a large map is rarer, so that it is no more
# traffic than this.
_MAX_CALLS_BEHIND = 10
_MAX_REPEATED_BYTES_PER_S = 40e3
# Room of a map that grows, a share of its length: it grows again when the room is used up.
_ROOM = 0.25


class MapTopic:
    """Publishes map and map_metadata, or map_updates.

    The map is whole where its rectangle grows or it is another map, and as long as somebody
    subscribes to map and not to map_updates. Else map_updates has the rectangle that has changed;
    the whole map follows ten calls later (of a map of 100 x 100 m after 100 s), or once a
    subscriber comes.
    Where all subscribe to both, the rectangle has room to grow; else it ends at the known cells.
    """

    def __init__(self, node: Node, frame_id: str) -> None:
        events = PublisherEventCallbacks(matched=self._on_matched)
        self._node = node
        self._frame_id = frame_id
        self._map = node.create_publisher(OccupancyGrid, 'map', qos.LATCHED, event_callbacks=events)
        self._metadata = node.create_publisher(MapMetaData, 'map_metadata', qos.LATCHED)
        self._updates = node.create_publisher(
            OccupancyGridUpdate,
            updates_topic(node, 'map'),
            qos.STREAM,
            event_callbacks=events,
        )
        self._newest: MapVersion | None = None
        self._shown: GridPatch | None = None  # what those know who have all messages
        self._calls_behind = 0  # since the newest whole map is out of date

    def publish(self, version: MapVersion, changed: Bounds | None) -> None:
        """Publish what has changed since the last call.

        changed: bounds within the version of all cells that may have; None: none has.
        """
        before = self._newest
        self._newest = version
        if self._shown is None or before is None or not version.extends(before):
            self._publish_whole(version, version.shown())
        elif any(margins := self._shown.overhang_of(version.patch)):
            self._publish_larger(version, self._shown.padded(_with_room(self._shown, margins)))
        else:
            self._publish_changes(version, None if changed is None else version.shown(changed))

    def _publish_larger(self, version: MapVersion, wide: GridPatch) -> None:
        shown = version.shown()
        if not self._has_subscriber_of_map_alone():
            shown = wide.with_part(*wide.offset_of(shown), shown.cells)
        self._publish_whole(version, shown)

    def _publish_changes(self, version: MapVersion, part: GridPatch | None) -> None:
        changed = None if part is None else self._take_in(part)
        if self._shown is None or (changed is None and not self._calls_behind):
            return
        self._calls_behind += 1
        if self._has_subscriber_of_map_alone():
            self._publish_whole(version, version.shown())
        elif self._calls_behind > _calls_between_whole(self._shown, version):
            self._publish_whole(version, self._shown)
        elif changed is not None:
            self._updates.publish(
                messages.map_update_msg(self._shown, changed, self._frame_id, version.stamp_ns)
            )

    def _take_in(self, part: GridPatch) -> GridPatch | None:
        """Take a part into what is shown; returns the rectangle that has changed, if any has."""
        if self._shown is None:
            return None
        row, col = self._shown.offset_of(part)
        rows, cols = part.shape
        changed = part.changes_since(self._shown.part((row, col, row + rows, col + cols)))
        if changed is None:
            return None
        self._shown = self._shown.with_part(row, col, part.cells)
        return part.part(changed)

    def _has_subscriber_of_map_alone(self) -> bool:
        """Whether a node subscribes to map more often than to map_updates."""
        subscribers = [
            Counter(diagnostics.subscriber_names(self._node, topic.topic_name))
            for topic in (self._map, self._updates)
        ]
        return bool(subscribers[0] - subscribers[1])

    def _publish_whole(self, version: MapVersion, shown: GridPatch) -> None:
        self._shown = shown
        self._calls_behind = 0
        load_ns = version.identity.load_ns
        message = messages.grid_msg(shown, self._frame_id, version.stamp_ns, load_ns)
        self._map.publish(message)
        self._metadata.publish(message.info)

    def _on_matched(self, matched: QoSPublisherMatchedInfo) -> None:
        """A new subscriber has the newest whole map, and none of the updates since."""
        is_behind = self._calls_behind > 0
        has_come = matched.current_count_change > 0
        if has_come and is_behind and self._newest is not None and self._shown is not None:
            self._publish_whole(self._newest, self._shown)


def _calls_between_whole(shown: GridPatch, version: MapVersion) -> float:
    """Calls after which the whole map follows an update."""
    period_s = shown.cells.nbytes / _MAX_REPEATED_BYTES_PER_S
    return max(_MAX_CALLS_BEHIND, period_s / version.identity.config.map_update_interval)


def _with_room(patch: GridPatch, margins: Margins) -> Margins:
    """Margins with room beyond those that are needed."""
    rows, cols = (round(_ROOM * length) for length in patch.shape)
    top, left, bottom, right = margins
    return (
        top + rows if top else 0,
        left + cols if left else 0,
        bottom + rows if bottom else 0,
        right + cols if right else 0,
    )


class MapPublishers:
    """Publishes the map for others, and the exact grid for thinmap's own nodes, when they change.

    frame_id: of the map; load_ns: time at which it was begun or loaded; followed: knows its id.
    """

    def __init__(self, node: Node, config: MapOutputConfig) -> None:
        self.config = config
        self.frame_id = parameters.declare_map_frame(node)
        self.load_ns = 0
        self.followed = FollowedMap()
        self._map = MapTopic(node, self.frame_id)
        self._grid = node.create_publisher(ProbabilityGrid, 'grid', qos.LATCHED)
        self._local_grid = node.create_publisher(LocalGrid, 'local_grid', qos.LATCHED)
        self._published: MapVersion | None = None

    def publish_map(self, whole: WholeMap, stamp_ns: int) -> None:
        """Publish what of map and grid has changed since the last call."""
        identity = MapIdentity(self.load_ns, whole.corrected_ns, self.followed.id, self.config)
        version = MapVersion(identity, whole.patch, stamp_ns)
        changed = version.changes_since(self._published)
        self._published = version
        if changed is not None:
            self._grid.publish(
                messages.whole_map_msg(
                    whole, self.frame_id, stamp_ns, self.load_ns, self.followed.id
                )
            )
        self._map.publish(version, changed)

    def map_message(self, patch: GridPatch, stamp_ns: int) -> OccupancyGrid:
        """Message of the topic map."""
        shown = self.config.shown(patch)
        return messages.grid_msg(shown, self.frame_id, stamp_ns, self.load_ns)

    def publish_local_grid(self, update: MapUpdate, localized: ReceivedScan) -> None:
        """Publish the part of a grid that a scan has changed, and the scan."""
        if update.changes is None:
            return
        cells = messages.probability_grid_msg(
            update.changes,
            self.frame_id,
            localized.scan.stamp_ns,
            self.load_ns,
            update.corrected_ns,
            self.followed.id,
        )
        self._local_grid.publish(
            LocalGrid(
                header=cells.header,
                localized=localized.message,
                grid=cells,
                is_rerendering=update.is_rerendering,
            )
        )


class ScanQueue:
    """Localized scans, which wait for a trajectory that their pose follows and that comes later.

    dropped: number of scans whose trajectory did not come.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._scans: deque[ReceivedScan] = deque()
        self._trajectory: Trajectory | None = None
        self._trajectory_ns = 0
        self._corrected_ns = 0

    def add_scan(self, localized: ReceivedScan) -> None:
        """Add a scan."""
        self._scans.append(localized)
        if len(self._scans) > qos.STREAM.depth:
            self._scans.popleft()
            self.dropped += 1

    def add_trajectory(self, message: Path) -> None:
        """Add a corrected trajectory. Raises InputError where a stamp or a pose is invalid."""
        trajectory = messages.trajectory_from_msg(message)
        self._trajectory = Trajectory(*trajectory, messages.stamp_ns(message.header.stamp))
        self._trajectory_ns = self._trajectory.since_ns

    def ready(self) -> Iterator[ReceivedScan]:
        """The scans that need not wait, each with the trajectory that must be followed before it.

        A trajectory that a newer one has replaced is left out: the newer one corrects the scans of
        both.
        """
        while self._scans and self._scans[0].corrected_ns <= max(
            self._corrected_ns, self._trajectory_ns
        ):
            localized = self._scans.popleft()
            is_new = localized.corrected_ns > self._corrected_ns
            is_here = localized.corrected_ns == self._trajectory_ns
            yield replace(localized, trajectory=self._trajectory if is_new and is_here else None)
            # Not before: if following it fails, the next scan has the trajectory, too.
            self._corrected_ns = localized.corrected_ns


@dataclass(frozen=True)
class RobotCutConfig(Config):
    """How much is cut out of scans around another robot."""

    robot_cut_radius_m: float = parameter(
        0.38,
        'Scan points within this distance of another robot of the team are not mapped (m). Set it '
        'to the radius of the largest robot and 0.13. The way since its last message is added.',
        low=0.0,
        high=10.0,
    )


class TeamInScans:
    """Tells a map which other robots are near by, and where their maps lie; without a team, none.

    Robots that are not joined yet are remembered, too, to be cut out of the scans once they are.
    """

    def __init__(self, node: ThinmapNode) -> None:
        """Declare the parameters."""
        self._heard = heard_robots(node)
        self._cut_m = parameters.declare_config(node, RobotCutConfig).robot_cut_radius_m

    @property
    def places(self) -> Mapping[str, Array]:
        """Where the maps of robots that are joined lie (3,), by their names."""
        return {} if self._heard is None else self._heard.places.poses

    def noted(self, scan: Scan) -> Scan:
        """A scan with the robots that were heard lately."""
        motions = [] if self._heard is None else self._heard.own_motions()
        robots = tuple(
            NearbyRobot(motion.robot, motion.pose, self._cut_m + abs(motion.v) * age_s)
            for motion, age_s in motions
        )
        return replace(scan, robots=robots) if robots else scan
