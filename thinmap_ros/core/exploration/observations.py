"""Scans with their poses, once the map contains them: what a strategy decides from."""

from typing import NamedTuple

from thinmap_ros.core.grid.map_receiver import MapReceiver
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stamp_matcher import StampMatcher
from thinmap_ros.core.topology.graph import TopologicalMap


class Observation(NamedTuple):
    """A scan made at a pose (3,) in the map frame, with the graph and the whole map of then."""

    topology: TopologicalMap
    patch: GridPatch
    scan: Scan
    T_map_base: Array


class ObservationBuffer:
    """Combines map, graph, scans and poses, which arrive in any order.

    A scan is complete with the pose of its stamp. Where local maps are published, it also waits for
    the local map of its stamp: evaluated against an older map, a scan shows nothing new.
    is_blind: whether the laser measures nothing, by the localizer; its scans are no observations.
    """

    def __init__(self, topology: TopologicalMap) -> None:
        self.topology = topology
        self.is_blind = False
        self._map = MapReceiver()
        self._has_local_map = False
        self._pose_matcher: StampMatcher[Scan, Array] = StampMatcher()
        self._mapped_scan_matcher: StampMatcher[tuple[Scan, Array], bool] = StampMatcher()

    def replace_map(self, patch: GridPatch) -> None:
        """Replace the whole map."""
        self._map.replace(patch)

    def add_local_map(self, stamp_ns: int, patch: GridPatch) -> Observation | None:
        """Add the local map of a stamp; returns the observation if it is complete now.

        Raises InputError where the local map does not fit the map.
        """
        self._map.paste(patch)
        self._has_local_map = True
        match = self._mapped_scan_matcher.add_right(stamp_ns, True)
        return None if match is None else self._observation(match[0])

    def add_pose(self, stamp_ns: int, T_map_base: Array) -> Observation | None:
        """Add the pose (3,) of a stamp; returns the observation if it is complete now."""
        return self._add_pair(self._pose_matcher.add_right(stamp_ns, T_map_base))

    def add_scan(self, scan: Scan) -> Observation | None:
        """Add a scan; returns the observation if it is complete now."""
        return self._add_pair(self._pose_matcher.add_left(scan.stamp_ns, scan))

    def _add_pair(self, pair: tuple[Scan, Array] | None) -> Observation | None:
        if pair is None:
            return None
        if not self._has_local_map:
            return self._observation(pair)
        match = self._mapped_scan_matcher.add_left(pair[0].stamp_ns, pair)
        return None if match is None else self._observation(match[0])

    def _observation(self, pair: tuple[Scan, Array]) -> Observation | None:
        """Observation of a scan and its pose; None without a map, or of a blind laser."""
        if self._map.patch is None or self.is_blind:
            return None
        return Observation(self.topology, self._map.patch, *pair)
