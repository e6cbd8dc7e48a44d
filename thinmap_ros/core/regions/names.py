"""Names that people give to regions."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.grid.moved import MapMotion
from thinmap_ros.core.regions.region_map import RegionMap
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import Field

MAX_NAMES = 1000
MAX_LENGTH = 64
_MAX_M = snapshot.MAX_COORDINATE_M
_MAX_LETTER = 0x10FFFF
FIELDS = {
    'name_anchors': Field(np.float64, ('n', 2), -_MAX_M, _MAX_M),
    # Code points, 0 behind the end.
    'name_letters': Field(np.int32, ('n', MAX_LENGTH), 0, _MAX_LETTER),
}


def checked_name(text: str) -> str:
    """A name without the spaces around it; '' stays.

    Raises InputError where it is too long or has a character that cannot be printed.
    """
    name = text.strip()
    if len(name) > MAX_LENGTH or not name.isprintable():
        raise InputError(
            f'name {quoted(text)}: expected at most {MAX_LENGTH} characters that can be printed'
        )
    return name


class RegionNames:
    """Names, each at a point of the map: the region around the point has the name.

    So a name stays at its room when regions are computed again, divided or joined.
    """

    def __init__(self) -> None:
        self._anchors = np.empty((0, 2))
        self._names: list[str] = []

    def put(self, regions: RegionMap, region_id: int, anchor: Array, name: str) -> None:
        """Give the region around an anchor (2,), m, a name instead of those it has; '': none.

        Raises InputError where there are too many names.
        """
        ids = regions.ids_at(self._anchors)
        others = np.flatnonzero(ids != region_id).tolist()
        if name and len(others) >= MAX_NAMES:
            raise InputError(f'name {quoted(name)}: expected at most {MAX_NAMES} names of regions')
        self._names = [self._names[i] for i in others] + ([name] if name else [])
        anchors = [self._anchors[others], np.reshape(anchor, (1, 2))[: 1 if name else 0]]
        self._anchors = np.vstack(anchors)

    def move(self, motion: MapMotion) -> None:
        """Move the names as the map."""
        if self._names:
            self._anchors = motion.moved(self._anchors)

    def add(self, others: 'RegionNames') -> None:
        """Add names of another map; in a region with a name of both, the own one stays.

        Raises InputError where there are too many names.
        """
        names = [*others._names, *self._names]
        _check_count(len(names))
        self._anchors = np.vstack([others._anchors, self._anchors])
        self._names = names

    def named(self, regions: RegionMap) -> RegionMap:
        """Regions with their names; of several in one region the newest."""
        ids = regions.ids_at(self._anchors).tolist()
        names = dict(zip(ids, self._names, strict=True))
        known = {
            number: replace(region, name=names.get(number, ''))
            for number, region in regions.regions.items()
        }
        return replace(regions, regions=known)

    def state(self) -> dict[str, NDArray[Any]]:
        """Arrays by name; `from_state` continues from them."""
        letters = np.zeros((len(self._names), MAX_LENGTH), dtype=np.int32)
        for row, name in zip(letters, self._names, strict=True):
            row[: len(name)] = [ord(letter) for letter in name]
        return {'name_anchors': self._anchors, 'name_letters': letters}

    @staticmethod
    def from_state(state: Mapping[str, NDArray[Any]]) -> 'RegionNames':
        """Names of the `state` of others. Raises InputError where it is no such state."""
        checked = snapshot.validate(state, FIELDS, 'names of regions')
        names = RegionNames()
        names._anchors = checked['name_anchors']
        names._names = [_text(row) for row in checked['name_letters'].tolist()]
        _check_count(len(names._names))
        return names


def _check_count(count: int) -> None:
    if count > MAX_NAMES:
        raise InputError(f'{count} names of regions: expected at most {MAX_NAMES}')


def _text(letters: list[int]) -> str:
    """A name by its code points. Raises InputError where it is none."""
    text = ''.join(map(chr, letters)).rstrip('\0')
    if not text or checked_name(text) != text:
        raise InputError(f'saved name {quoted(text)}: expected the name of a region')
    return text
