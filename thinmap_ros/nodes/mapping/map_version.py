"""The map of grid_mapper at a time, with what distinguishes it from other maps."""

from dataclasses import dataclass

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.nodes.mapping.map_values import MapOutputConfig


@dataclass(frozen=True)
class MapIdentity:
    """Which map it is, and how it is shown; load_ns, corrected_ns, map_id: as in the messages."""

    load_ns: int
    corrected_ns: int
    map_id: int
    config: MapOutputConfig


@dataclass(frozen=True, eq=False)
class MapVersion:
    """All known cells of the map, in percent, and the stamp of the last scan in it."""

    identity: MapIdentity
    patch: GridPatch
    stamp_ns: int

    def extends(self, before: 'MapVersion') -> bool:
        """Whether it is the same map as before, and covers all that was known then."""
        if self.identity != before.identity or not self.patch.is_aligned_with(before.patch):
            return False
        return not any(self.patch.overhang_of(before.patch))

    def differs(self, before: 'MapVersion') -> bool:
        """Whether anything differs from a version before."""
        return (
            self.identity != before.identity
            or self.patch.frame != before.patch.frame
            or self.patch.shape != before.patch.shape
            or self.patch.changes_since(before.patch) is not None
        )

    def shown(self) -> GridPatch:
        """The cells with the values to publish."""
        return self.identity.config.shown(self.patch)
