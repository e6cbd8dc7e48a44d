"""Regions of a map and the doors between them, as values."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.se2 import Array


class RegionKind(IntEnum):
    """What a region is, by its shape."""

    ROOM = 0
    CORRIDOR = 1
    HALL = 2


@dataclass(frozen=True, eq=False)
class Region:
    """A room, corridor or hall.

    x, y: a free place far from walls, m, map frame; area_m2: free area; outline (K, 2): outer
    boundary, counterclockwise and not closed, m, map frame; name: that a person has given, '' for
    none.
    """

    id: int
    kind: RegionKind
    x: float
    y: float
    area_m2: float
    outline: Array
    name: str = ''


@dataclass(frozen=True)
class Door:
    """A narrow passage between the regions a and b.

    x, y: where it is narrowest, m, map frame; width_m: free width there.
    """

    a: int
    b: int
    x: float
    y: float
    width_m: float


@dataclass(frozen=True, eq=False)
class RegionMap:
    """Regions by id; labels (H, W): id of the region of each cell of a grid, 0 for none."""

    frame: GridFrame
    labels: NDArray[np.int32]
    regions: Mapping[int, Region]
    doors: tuple[Door, ...]

    def ids_at(self, points: Array) -> NDArray[np.int32]:
        """Id of the region at each point (N, 2), m, map frame; 0 for none."""
        cells = self.frame.cells_of(points)
        inside = np.all((cells >= 0) & (cells < self.labels.shape), axis=1)
        ids = np.zeros(len(cells), dtype=np.int32)
        ids[inside] = self.labels[cells[inside, 0], cells[inside, 1]]
        return ids

    def neighbours(self, region_id: int) -> list[int]:
        """Ids of the regions that a door joins to a region, each once."""
        return self.all_neighbours().get(region_id, [])

    def all_neighbours(self) -> dict[int, list[int]]:
        """Neighbours of each region that has a door, by id."""
        found: dict[int, set[int]] = {}
        for door in self.doors:
            found.setdefault(door.a, set()).add(door.b)
            found.setdefault(door.b, set()).add(door.a)
        return {region: sorted(ends) for region, ends in found.items()}
