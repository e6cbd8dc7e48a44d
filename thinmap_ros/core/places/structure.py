"""What contradicts a place: walls of one map in what the other one has seen to be free.

Storeys of a building have one outline, and rooms along a corridor one shape: views of one fit into
another. Inner walls tell them apart.
"""

import math

import numpy as np

from thinmap_ros.core.grid.fields import label
from thinmap_ros.core.grid.moved import MapMotion
from thinmap_ros.core.places.piece import MapPiece
from thinmap_ros.core.places.views import RANGE_M
from thinmap_ros.core.se2 import Mask

# Of connected wall, at least: what is shorter is furniture that has moved, a person, or a door.
_WALL_M = 1.5

# Wall that is contrary, for each metre that is found again. Measured: at most 0.009 at the right
# place in maps of two visits, 0.066 to 0.13 on another storey, 0.01 to 0.05 where both have seen
# little of what differs. With twice as much, half of the latter are joined.
_SAME_RATE = 0.005
_OTHER_RATE = 0.05


def structure_evidence(
    query: MapPiece, known: MapPiece, motion: MapMotion, reach_m: float = RANGE_M
) -> float:
    """Log likelihood ratio of the walls of two maps: of one place, against two that look alike.

    Walls that are contrary come by chance, one of _WALL_M each, at a rate for each metre that is
    found again. motion: of places from the query to the known map. Walls within reach of these are
    compared, each moved as the nearest one: maps bend.
    """
    forth = _wall_lengths(query, known, MapMotion(motion.after, motion.before), reach_m)
    back = _wall_lengths(known, query, motion, reach_m)
    found_m, contrary_m = (a + b for a, b in zip(forth, back, strict=True))
    expected = (_OTHER_RATE - _SAME_RATE) * found_m
    return (expected - math.log(_OTHER_RATE / _SAME_RATE) * contrary_m) / _WALL_M


def storey_evidence(
    query: MapPiece, known: MapPiece, motion: MapMotion, reach_m: float = RANGE_M
) -> float:
    """Log likelihood ratio of one storey against two, as `structure_evidence`.

    Infinite where the tags of both maps say that it is one.
    """
    if query.tag and query.tag == known.tag:
        return math.inf
    return structure_evidence(query, known, motion, reach_m)


def _wall_lengths(
    own: MapPiece, other: MapPiece, motion: MapMotion, reach_m: float
) -> tuple[float, float]:
    """Length of the walls of a map that another one shows again, and that lie in its free space.

    motion: of places from the other map to this one. In m.
    """
    place = motion.nearest_after(own.walls)
    is_near = np.hypot(*(own.walls - motion.after[place, :2]).T) < reach_m
    walls = own.walls[is_near]
    found, contrary = other.field.told(motion.undone(walls, place[is_near]))
    cells = np.zeros(own.patch.shape, dtype=np.bool_)
    cells[tuple(own.patch.frame.cells_of(walls[contrary]).T)] = True
    cell_m = own.patch.frame.resolution
    return cell_m * np.count_nonzero(found), cell_m * _count_long(cells, _WALL_M / cell_m)


def _count_long(cells: Mask, least: float) -> int:
    """How many of the cells (H, W) are in connected parts of at least some length, in cells."""
    parts, counts = label(cells)
    found = np.argwhere(cells)
    owner = parts[tuple(found.T)]
    low = np.full((len(counts), 2), np.inf)
    high = -low
    np.minimum.at(low, owner, found)
    np.maximum.at(high, owner, found)
    is_long = np.hypot(*(high - low).T) >= least
    return int(np.count_nonzero(is_long[owner]))
