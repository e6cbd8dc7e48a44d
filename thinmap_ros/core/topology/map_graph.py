"""Graph of a map that comes as a whole, again and again."""

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.builder import TopologyConfig, build_again
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.core.topology.registry import Registry

# The time for the graph of the whole of a map grows with its cells.
_GRAPH_PERIOD_NS = 2_000_000_000
_CELLS_A_PERIOD = 1_000_000


class MapGraph:
    """Builds the graph of the whole map again when it has changed, at most every two seconds.

    Maps above a million cells are processed proportionally less often. Nodes and edges keep their
    ids from one map to the next.
    """

    def __init__(self, config: TopologyConfig) -> None:
        self._config = config
        self._registry: Registry | None = None
        self._patch: GridPatch | None = None
        self._built_ns = 0

    def update(self, patch: GridPatch, T_map_base: Array, stamp_ns: int) -> TopologicalMap:
        """Graph of what can be reached from a pose (3,) in a map.

        An earlier one within the period, and where the robot stands in no free space.
        """
        if self._registry is not None and not self._is_due(patch, stamp_ns):
            return self._registry.map
        self._patch = patch
        self._built_ns = stamp_ns
        seed_xy = (float(T_map_base[0]), float(T_map_base[1]))
        registry = build_again(self._registry, patch, seed_xy, self._config)
        if self._registry is None or registry.map.nodes:
            self._registry = registry
        return self._registry.map

    def _is_due(self, patch: GridPatch, stamp_ns: int) -> bool:
        if patch is self._patch:
            return False
        period_ns = _GRAPH_PERIOD_NS * max(1.0, patch.cells.size / _CELLS_A_PERIOD)
        return not 0 <= stamp_ns - self._built_ns < period_ns
