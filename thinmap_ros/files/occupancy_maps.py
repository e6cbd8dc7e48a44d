"""Reads and writes map_server maps: an image and a YAML file.

Images are read within limits (`files/images.py`): at most 33,554,432 pixels, a square of 289 m at
0.05 m a cell, and 16,384 on a side, 819 m. A rotated map has at most as many cells.
"""

from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, one_line_reason, quoted
from thinmap_ros.core.grid.patch import OCCUPIED_AT_LEAST, UNKNOWN, GridPatch
from thinmap_ros.core.grid.rotated import aligned_patch
from thinmap_ros.core.se2 import MAX_COORDINATE_M, Array
from thinmap_ros.files.atomic import atomic_write, write_text
from thinmap_ros.files.images import read_cells
from thinmap_ros.files.limits import FILES
from thinmap_ros.files.regular_files import open_regular_file
from thinmap_ros.files.yaml import read_mapping

_MARK = '# written by thinmap'


class _Grey(IntEnum):
    """Grey values of a trinary map, as map_saver writes them."""

    FREE = 254
    UNKNOWN = 205
    OCCUPIED = 0


def write_map(stem: Path, patch: GridPatch) -> Path:
    """Write STEM.pgm and STEM.yaml (trinary mode); returns the path of the YAML file."""
    from PIL import Image  # imported here: most processes never write or read a map

    grey = np.full(patch.shape, _Grey.UNKNOWN, dtype=np.uint8)
    grey[patch.free] = _Grey.FREE
    grey[patch.occupied] = _Grey.OCCUPIED
    image = stem.with_name(stem.name + '.pgm')
    description = stem.with_name(stem.name + '.yaml')
    with atomic_write(image) as aside:
        Image.fromarray(grey[::-1]).save(aside, format='PPM')
        # The image is renamed last: if the disk is full, the old map remains unchanged.
        content = yaml.safe_dump(_description(image.name, patch), sort_keys=False)
        write_text(description, f'{_MARK}\n{content}')
    return description


def is_own_map(description: Path) -> bool:
    """Whether a YAML file of a map was written by `write_map`."""
    try:
        with open_regular_file(description) as stream:
            return stream.readline(len(_MARK) + 1) == f'{_MARK}\n'.encode()
    except OSError:
        return False


def _description(image: str, patch: GridPatch) -> dict[str, Any]:
    frame = patch.frame
    return {
        'image': image,
        'mode': 'trinary',
        'resolution': frame.resolution,
        'origin': [round(frame.origin_x, 6), round(frame.origin_y, 6), 0.0],
        'negate': 0,
        'occupied_thresh': OCCUPIED_AT_LEAST / 100,
        # map_saver writes 0.25 beside the same grey values, but map_server takes each pixel below
        # free_thresh as free, and unknown is 50/255 = 0.19608 dark: the map would lose what is
        # unknown. Another grey value would not be unknown to readers that expect 205.
        'free_thresh': 0.196,
    }


def read_map(path: Path, folder: Path | None = None) -> GridPatch:
    """Read a map from its YAML file; trinary and scale modes.

    folder: if given, the image must be inside of it. Raises InputError with file, key, value and
    expectation. A map with a yaw in its origin is resampled.
    """
    content = read_mapping(path, 'a map_server YAML file')
    image = _image_of(path, content, folder)
    resolution = _resolution(path, content)
    origin = _origin(path, content)
    shades = _Shades.of(path, content)
    cells = _cells(path, image, shades)
    return aligned_patch(origin, resolution, cells, FILES.image_pixels)


def read_resolution(path: Path) -> float:
    """Edge of a cell (m) of a map, from its YAML file. Raises InputError as `read_map`."""
    return _resolution(path, read_mapping(path, 'a map_server YAML file'))


def _resolution(path: Path, content: dict[str, Any]) -> float:
    return _number(path, content, 'resolution', 1e-3, 10.0)


def _image_of(path: Path, content: dict[str, Any], folder: Path | None) -> Path:
    name = content.get('image')
    if not isinstance(name, str) or not name.isprintable() or len(name) > FILES.name_length:
        raise InputError(f'{path}: image: {quoted(name)}: expected the name of an image')
    image = path.parent / name
    if folder is not None and not image.resolve().is_relative_to(folder):
        raise InputError(f'{path}: image: {quoted(name)}: expected a file below {folder}')
    return image


def _number(
    path: Path,
    content: dict[str, Any],
    key: str,
    low: float,
    high: float,
    default: float | None = None,
) -> float:
    value = content.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise InputError(f'{path}: {key}: {quoted(value)}: expected a number from {low} to {high}')
    return float(value)


def _is_negated(path: Path, content: dict[str, Any]) -> bool:
    value = content.get('negate', 0)
    if value not in (0, 1):  # false and true count as such
        raise InputError(f'{path}: negate: {quoted(value)}: expected 0 or 1')
    return bool(value)


def _origin(path: Path, content: dict[str, Any]) -> Array:
    value = content.get('origin')
    numbers = value if isinstance(value, list) else []
    fit = all(isinstance(v, int | float) and abs(v) <= MAX_COORDINATE_M for v in numbers)
    if len(numbers) != 3 or not fit:
        raise InputError(f'{path}: origin: {quoted(value)}: expected [x, y, yaw] in m, m, rad')
    return se2.pose(*(float(v) for v in numbers))


@dataclass(frozen=True)
class _Shades:
    """Thresholds for the conversion of grey values to cells."""

    occupied: float
    free: float
    scale: bool
    negate: bool

    @staticmethod
    def of(path: Path, content: dict[str, Any]) -> '_Shades':
        occupied = _number(path, content, 'occupied_thresh', 0.0, 1.0, default=0.65)
        free = _number(path, content, 'free_thresh', 0.0, 1.0, default=0.25)
        mode = content.get('mode', 'trinary')
        if mode not in ('trinary', 'scale'):
            raise InputError(f'{path}: mode: {quoted(mode)}: expected trinary or scale')
        if not free < occupied:
            expected = f'expected less than occupied_thresh ({occupied})'
            raise InputError(f'{path}: free_thresh: {free}: {expected}')
        return _Shades(occupied, free, mode == 'scale', _is_negated(path, content))

    def table(self, greys: int) -> NDArray[np.int8]:
        """Cell value of each grey value from 0 to greys - 1."""
        shade = np.arange(greys) / (greys - 1)
        darkness = shade if self.negate else 1.0 - shade
        cells = np.full(greys, UNKNOWN, dtype=np.int8)
        if self.scale:
            share = np.clip((darkness - self.free) / (self.occupied - self.free), 0.0, 1.0)
            cells = (1 + 98 * share).astype(np.int8)
        cells[darkness < self.free] = 0
        cells[darkness > self.occupied] = 100
        return cells


def _cells(path: Path, image: Path, shades: _Shades) -> NDArray[np.int8]:
    """Cells (H, W) of an image, bottom row first. Raises InputError where it cannot be read."""
    try:
        return read_cells(image, shades.table)
    except Exception as error:  # Pillow raises many types for corrupt images
        reason = getattr(error, 'strerror', None) or one_line_reason(error)
        raise InputError(f'{image}: {reason}: expected an image that {path} names') from error
