"""Colours of the page with what they mean: those of summary.png."""

from thinmap_ros.core.topology.graph import NodeKind
from thinmap_ros.core.topology.regions import RegionKind
from thinmap_ros.view import palette


def colours() -> dict[str, str]:
    """Colour of each thing that is drawn, by its name on the page."""
    return {
        'end node': palette.NODES[NodeKind.END],
        'branch node': palette.NODES[NodeKind.BRANCH],
        'corner node': palette.NODES[NodeKind.CORNER],
        'edge': palette.EDGE,
        'robot and its path': palette.ESTIMATE,
        'other robots': palette.ROBOTS[4],
        'laser': palette.PALETTE[5],
        'mapped apart': palette.APART,
        'room': palette.REGIONS[RegionKind.ROOM][0],
        'corridor': palette.REGIONS[RegionKind.CORRIDOR][0],
        'hall': palette.REGIONS[RegionKind.HALL][0],
        'plan and goal': palette.TRUTH,
        'keep out': palette.KEEP_OUT,
        'limit of the exploration': palette.HIDDEN,
    }
