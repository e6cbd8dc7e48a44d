"""Editing of the map by services: keep-out areas, virtual walls, and parts that are erased."""

from collections.abc import Callable
from typing import Any

import numpy as np
from nav2_msgs.msg import CostmapFilterInfo
from nav_msgs.msg import OccupancyGrid

from thinmap_msgs.msg import KeepOut as KeepOutMsg
from thinmap_msgs.msg import KeepOutArea as KeepOutAreaMsg
from thinmap_msgs.srv import AddKeepOut, EraseArea, RemoveKeepOut
from thinmap_ros.core.errors import InputError, counted
from thinmap_ros.core.grid.edits import KeepOut
from thinmap_ros.core.grid.mapper import Mapper
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.logs import decode
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.services import fill_response, offer

_FREE = np.int8(0)
_FORBIDDEN = np.int8(100)
_KEEPOUT_FILTER = 0  # type of Nav2's filter


class MapEditing:
    """Services add_keep_out, remove_keep_out and erase_area; publishes keep_out for all who plan.

    keepout_filter_mask and costmap_filter_info are those of Nav2's keepout filter.
    is_edited: whether anything was edited since the node was started.
    """

    def __init__(
        self,
        node: ThinmapNode,
        frame_id: str,
        mapper: Mapper,
        latest_ns: Callable[[], int | None],
        on_erased: Callable[[], None],
    ) -> None:
        """frame_id: of the map; latest_ns: stamp of the newest scan in it, None without a map.

        on_erased: is called when cells have become unknown.
        """
        self.is_edited = False
        self._node = node
        self._frame_id = frame_id
        self._mapper = mapper
        self._latest_ns = latest_ns
        self._on_erased = on_erased
        self._published: tuple[KeepOut, GridFrame] | None = None
        self._areas = node.create_publisher(KeepOutMsg, 'keep_out', qos.LATCHED)
        self._mask = node.create_publisher(OccupancyGrid, 'keepout_filter_mask', qos.LATCHED)
        self._info = node.create_publisher(CostmapFilterInfo, 'costmap_filter_info', qos.LATCHED)
        node.create_active_service(AddKeepOut, 'add_keep_out', self._on_add)
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
        self._mask.publish(messages.grid_msg(mask, self._frame_id, self._now_ns()))

    def _header(self) -> Any:
        return messages.header(self._frame_id, self._now_ns())

    def _now_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)

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
