"""Names of regions: given by a service, and moved with the map."""

import numpy as np

from thinmap_msgs.srv import NameRegion
from thinmap_ros.core import errors
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.mapper import WholeMap
from thinmap_ros.core.grid.moved import MapMotion
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.regions import RegionMap, checked_name
from thinmap_ros.core.topology.segmentation import RegionTracker
from thinmap_ros.nodes.mapping.region_updates import RegionUpdates
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.services import offer


class RegionNaming:
    """Service name_region: a region has a name, which stays at its place in the building."""

    def __init__(self, node: ThinmapNode, regions: RegionUpdates) -> None:
        self._node = node
        self._regions = regions
        self._corrected_ns = 0
        self._of: RegionTracker | None = None  # whose names follow this correction
        offer(node.create_active_service, NameRegion, 'name_region', self._name)

    def follow(self, whole: WholeMap) -> None:
        """Move the names as a correction has moved the map."""
        tracker = self._regions.tracker
        is_next = self._of is tracker and self._corrected_ns == whole.previous_ns
        if is_next and whole.corrected_ns > self._corrected_ns and len(whole.moved.before):
            tracker.names.move(MapMotion(*whole.moved))
        self._of = tracker
        self._corrected_ns = whole.corrected_ns

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
