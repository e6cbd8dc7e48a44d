"""What a strategy decides from."""

from typing import NamedTuple

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap


class Observation(NamedTuple):
    """A scan made at a pose (3,) in the map frame, with the graph and the whole map of then."""

    topology: TopologicalMap
    patch: GridPatch
    scan: Scan
    T_map_base: Array
