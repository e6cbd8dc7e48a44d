"""The topological map of a grid that somebody else publishes."""

from thinmap_ros.core.exploration.live.stable_ids import StableIds
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.builder import TopologyConfig, build
from thinmap_ros.core.topology.graph import TopologicalMap

# The time for the whole of a map grows with its cells.
_PERIOD_NS = 2_000_000_000
_CELLS = 1_000_000


class MapGraph:
    """Builds the graph of the whole map again when it has changed, at most every two seconds.

    Maps above a million cells are processed proportionally less often. Nodes and edges keep their
    ids from one map to the next.
    """

    def __init__(self, config: TopologyConfig) -> None:
        self.config = config
        self._ids = StableIds(config.node_match_radius_m)
        self._patch: GridPatch | None = None
        self._built_ns = 0

    def update(self, patch: GridPatch, T_map_base: Array, stamp_ns: int) -> TopologicalMap:
        """Graph of what can be reached from a pose (3,) in a map.

        An earlier one within the period, and where the robot stands in no free space.
        """
        if self._patch is not None and not self._is_due(patch, stamp_ns):
            return self._ids.map
        self._patch = patch
        self._built_ns = stamp_ns
        found = build(patch, (float(T_map_base[0]), float(T_map_base[1])), self.config)
        return self._ids.renamed(found) if found.nodes else self._ids.map

    def _is_due(self, patch: GridPatch, stamp_ns: int) -> bool:
        if patch is self._patch:
            return False
        period_ns = _PERIOD_NS * max(1.0, patch.cells.size / _CELLS)
        return not 0 <= stamp_ns - self._built_ns < period_ns
