"""Colours of figures and views: the colour-blind safe palette of Okabe and Ito."""

from thinmap_ros.core.topology.graph import NodeKind

NODES = {NodeKind.END: '#D55E00', NodeKind.BRANCH: '#0072B2', NodeKind.CORNER: '#E69F00'}
EDGE = '#009E73'
ESTIMATE = '#CC79A7'
TRUTH = '#56B4E9'

# For curves, in the order of best contrast.
PALETTE = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '#555555')


def rgb(colour: str) -> list[int]:
    """Red, green and blue, 0 to 255, of `#RRGGBB`."""
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
