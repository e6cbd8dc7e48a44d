"""Regions as messages."""

from collections.abc import Mapping

from geometry_msgs.msg import Point

from thinmap_msgs.msg import Door as DoorMsg
from thinmap_msgs.msg import Region as RegionMsg
from thinmap_msgs.msg import RegionArray
from thinmap_ros.core.topology.regions import Door, Membership, Region
from thinmap_ros.ros import messages


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
