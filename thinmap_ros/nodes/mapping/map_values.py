"""The map of grid_mapper at a time: its values, its rate, and what distinguishes it from others."""

from dataclasses import dataclass

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError
from thinmap_ros.core.grid.patch import Bounds, GridPatch

TRINARY = 'trinary'
PROBABILITY = 'probability'


@dataclass(frozen=True)
class MapOutputConfig(Config):
    """How the topic map is published."""

    map_values: str = parameter(
        TRINARY,
        'Values of map. trinary: -1 unknown, 0 free, 100 occupied, as slam_toolbox and map_server '
        'publish them. probability: -1 or the probability of occupancy (%).',
        choices=(TRINARY, PROBABILITY),
    )
    occupied_thresh: float = parameter(
        0.65,
        'Probability from which a cell of a trinary map is occupied. Raise it against walls that '
        'people leave behind, lower it for thin obstacles.',
        low=0.0,
        high=1.0,
    )
    free_thresh: float = parameter(
        0.25,
        'Probability up to which a cell of a trinary map is free. Lower it to show only cells as '
        'free that many beams have crossed.',
        low=0.0,
        high=1.0,
    )
    map_update_interval: float = parameter(
        1.0,
        'Least time between two messages of map or map_updates (s). Raise it to save CPU and '
        'network traffic with large maps.',
        low=0.05,
        high=3600.0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.free_thresh < self.occupied_thresh:
            expected = f'expected less than occupied_thresh ({self.occupied_thresh})'
            raise ConfigError(f'free_thresh = {self.free_thresh}: {expected}')

    def shown(self, patch: GridPatch) -> GridPatch:
        """The patch with the values to publish."""
        return patch if self.map_values == PROBABILITY else self.trinary(patch)

    def trinary(self, patch: GridPatch) -> GridPatch:
        """The patch with -1, 0 and 100, in whole percent as map_saver compares them."""
        limits = (round(100.0 * self.free_thresh), round(100.0 * self.occupied_thresh))
        return GridPatch(patch.frame, patch.trinary(*limits))


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
