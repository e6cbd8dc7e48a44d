"""map_server maps: an image and a YAML file <-> a patch of cells."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from thinmap_ros.adapters.files import read_yaml, write_text, written_aside
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import OCCUPIED_AT_LEAST, UNKNOWN, GridPatch

# Grey values of a trinary map, as map_saver writes them.
_GREY_FREE, _GREY_UNKNOWN, _GREY_OCCUPIED = 254, 205, 0
_FAR_M = 1e7


def write_map(stem: Path, patch: GridPatch) -> Path:
    """Write STEM.pgm and STEM.yaml (trinary mode); returns the path of the YAML file."""
    from PIL import Image  # here: most nodes that could write or read a map never do

    grey = np.full(patch.shape, _GREY_UNKNOWN, dtype=np.uint8)
    grey[patch.free] = _GREY_FREE
    grey[patch.occupied] = _GREY_OCCUPIED
    image, description = stem.with_name(stem.name + '.pgm'), stem.with_name(stem.name + '.yaml')
    with written_aside(image) as aside:
        Image.fromarray(grey[::-1]).save(aside, format='PPM')
        # The image takes its name last: where there is no room for both, the old map stays as it was.
        write_text(description, yaml.safe_dump(_description(image.name, patch), sort_keys=False))
    return description


def _description(image: str, patch: GridPatch) -> dict[str, Any]:
    frame = patch.frame
    return {
        'image': image,
        'mode': 'trinary',
        'resolution': frame.resolution,
        'origin': [round(frame.origin_x, 6), round(frame.origin_y, 6), 0.0],
        'negate': 0,
        'occupied_thresh': OCCUPIED_AT_LEAST / 100,
        # Below the darkness of the grey for unknown (50/255): with 0.25, readers would take it for free.
        'free_thresh': 0.196,
    }


def read_map(path: Path) -> GridPatch:
    """Read a map from its YAML file; trinary and scale modes.

    Raises InputError naming the file, the key, its value and what was expected.
    """
    content = read_yaml(path, 'a map_server YAML file')
    if not isinstance(content.get('image'), str):
        raise InputError(f'{path}: image: {content.get("image")!r}: expected the name of an image')
    resolution = _number(path, content, 'resolution', 1e-3, 10.0)
    origin = _origin(path, content)
    image = path.parent / content['image']
    darkness = _darkness(path, image, _is_negated(path, content))
    cells = _cells(path, content, darkness)
    return GridPatch(GridFrame(origin[0], origin[1], resolution), np.ascontiguousarray(cells[::-1]))


def _number(
    path: Path, content: dict[str, Any], key: str, low: float, high: float, default: float | None = None
) -> float:
    value = content.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise InputError(f'{path}: {key}: {value!r}: expected a number from {low} to {high}')
    return float(value)


def _is_negated(path: Path, content: dict[str, Any]) -> bool:
    value = content.get('negate', 0)
    if value not in (0, 1):  # false and true count as such
        raise InputError(f'{path}: negate: {value!r}: expected 0 or 1')
    return bool(value)


def _origin(path: Path, content: dict[str, Any]) -> list[float]:
    value = content.get('origin')
    numbers = value if isinstance(value, list) else []
    if len(numbers) != 3 or not all(isinstance(v, int | float) and abs(v) < _FAR_M for v in numbers):
        raise InputError(f'{path}: origin: {value!r}: expected [x, y, yaw] in m, m, rad')
    if numbers[2] != 0:
        raise InputError(f'{path}: origin: yaw {numbers[2]}: expected 0; turned maps are not read')
    return [float(v) for v in numbers]


def _darkness(path: Path, image: Path, negate: bool) -> NDArray[np.float64]:
    """How dark each pixel is, 0 to 1, first row on top; NaN where it is transparent."""
    from PIL import Image

    try:
        with Image.open(image) as opened:
            opened.load()
            alpha = np.asarray(opened.convert('RGBA'))[..., 3] if 'A' in opened.getbands() else None
            deep = opened.mode.startswith(('I', 'F'))
            grey = np.asarray(opened if deep else opened.convert('L'), dtype=np.float64)
    except Exception as error:  # Pillow's readers raise whatever a broken image makes them stumble over
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise InputError(f'{image}: {reason}: expected an image that {path} names') from error
    shade = grey / (65535.0 if deep else 255.0)
    darkness = shade if negate else 1.0 - shade
    return darkness if alpha is None else np.where(alpha == 0, np.nan, darkness)


def _cells(path: Path, content: dict[str, Any], darkness: NDArray[np.float64]) -> NDArray[np.int8]:
    occupied = _number(path, content, 'occupied_thresh', 0.0, 1.0, default=0.65)
    free = _number(path, content, 'free_thresh', 0.0, 1.0, default=0.25)
    mode = content.get('mode', 'trinary')
    if mode not in ('trinary', 'scale'):
        raise InputError(f'{path}: mode: {mode!r}: expected trinary or scale')
    if not free < occupied:
        raise InputError(f'{path}: free_thresh: {free}: expected less than occupied_thresh ({occupied})')
    between = np.full(darkness.shape, UNKNOWN, dtype=np.int8)
    if mode == 'scale':
        share = np.clip((darkness - free) / (occupied - free), 0.0, 1.0)
        between = np.where(np.isnan(share), UNKNOWN, 1 + 98 * np.nan_to_num(share)).astype(np.int8)
    cells = np.where(darkness > occupied, np.int8(100), np.where(darkness < free, np.int8(0), between))
    return cells.astype(np.int8)
