"""The map of grid_mapper at a time, with what distinguishes it from other maps."""

from dataclasses import dataclass

from thinmap_ros.core.grid.patch import Bounds, GridPatch
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

    def changes_since(self, before: 'MapVersion | None') -> Bounds | None:
        """Bounds of all cells that differ from a version before; None: nothing differs."""
        is_same_rectangle = (
            before is not None
            and self.identity == before.identity
            and self.patch.frame == before.patch.frame
            and self.patch.shape == before.patch.shape
        )
        if before is None or not is_same_rectangle:
            return (0, 0, *self.patch.shape)
        if self.patch is before.patch:
            return None
        return self.patch.changes_since(before.patch)

    def shown(self, bounds: Bounds | None = None) -> GridPatch:
        """The cells within bounds, or all, with the values to publish."""
        part = self.patch if bounds is None else self.patch.part(bounds)
        return self.identity.config.shown(part)
