"""Colours of figures and views: the colour-blind safe palette of Okabe and Ito."""

from thinmap_ros.core.topology.graph import NodeKind
from thinmap_ros.core.topology.regions import RegionKind

NODES = {NodeKind.END: '#D55E00', NodeKind.BRANCH: '#0072B2', NodeKind.CORNER: '#E69F00'}
EDGE = '#009E73'
ESTIMATE = '#CC79A7'
TRUTH = '#332288'
# Paths of several robots; none is a colour of nodes or edges.
ROBOTS = ('#332288', '#CC79A7', '#56B4E9', '#999933', '#661100', '#555555')
HIDDEN = '#882255'
APART = '#A6761D'
KEEP_OUT = '#D41159'
# Pale, in turn by id.
REGIONS = {
    RegionKind.ROOM: ('#C9DFF2', '#D6D3EC', '#C5E3EA', '#DCE6F5'),
    RegionKind.CORRIDOR: ('#FBE7B5', '#F8DCC0'),
    RegionKind.HALL: ('#D2EBCB', '#E2F0BF'),
}
# For curves, in the order of best contrast.
PALETTE = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '#555555')


def region(kind: RegionKind, region_id: int) -> str:
    """Colour of a region."""
    shades = REGIONS[kind]
    return shades[region_id % len(shades)]


def rgb(colour: str) -> list[int]:
    """Red, green and blue, 0 to 255, of `#RRGGBB`."""
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
