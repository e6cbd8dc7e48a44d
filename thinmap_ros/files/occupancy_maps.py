"""Reads and writes map_server maps: an image and a YAML file.

Images are read within limits: at most 268,435,456 pixels, and 16,384 on a side, 819 m at 0.05 m a
cell. A rotated map has at most as many cells.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum, StrEnum
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import yaml
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, one_line_reason, quoted, require_type
from thinmap_ros.core.grid.moved import aligned_patch
from thinmap_ros.core.grid.patch import FREE_AT_MOST, OCCUPIED_AT_LEAST, UNKNOWN, GridPatch
from thinmap_ros.core.se2 import MAX_COORDINATE_M, Array
from thinmap_ros.core.stage import checked_tag
from thinmap_ros.files.safe import (
    FILES,
    PIECE_BYTES,
    atomic_write,
    boolean_of,
    number_of,
    open_regular_file,
    path_of,
    read_texts,
    write_text,
)

if TYPE_CHECKING:
    from PIL import Image

# Readers of other formats run programs, or decode before they check the size.
_FORMATS = ('PPM', 'PNG', 'BMP', 'JPEG')
_PLAIN_NETPBM = (b'P1', b'P2', b'P3')
_GREYS_8 = 1 << 8
_GREYS_16 = 1 << 16
_SUMS_OF_COLOURS = 3 * 255 + 1
_STRIP_ROWS = 64


@dataclass(frozen=True, eq=False)
class _ImageCells:
    """Cells of an image (H, W), its bottom row first, and how many pixels have which level.

    counts (levels,): from black to white, without pixels that are unknown as they are transparent.
    """

    cells: NDArray[np.int8]
    counts: NDArray[np.int64]


def _read_cells(path: Path, shades: '_Shades') -> _ImageCells:
    """Read the cells of an image: PGM (or another netpbm format), PNG, BMP or JPEG.

    Its size is that of the header, and is checked before pixels are decoded. Besides the decoded
    image and its cells, the conversion takes the memory of one strip of rows.

    The level of a pixel is the sum of red, green and blue, as map_server takes their mean; the
    luminance of an image would make a green wall lighter than a red one.

    Raises OSError, ValueError, or another error of the decoder for an image that cannot be read.
    """
    from PIL import Image  # imported here: most processes never read a map

    # Pillow's own limit is lower. Above it Pillow only warns: here this is an error.
    Image.MAX_IMAGE_PIXELS = FILES.image_pixels
    with warnings.catch_warnings(), open_regular_file(path) as stream:
        warnings.simplefilter('error', Image.DecompressionBombWarning)
        _check_header(stream)
        with Image.open(stream, formats=_FORMATS) as image:
            image.load()
            return _cells_of(image, shades)


def _check_header(stream: BinaryIO) -> None:
    """Check the size of an image, of which only the first bytes are read.

    Raises ValueError, or another error of the decoder where the header does not end in them.
    """
    from PIL import Image, UnidentifiedImageError

    start = stream.read(FILES.image_header_bytes)
    try:
        with Image.open(BytesIO(start), formats=_FORMATS) as image:
            width, height = image.size
    except UnidentifiedImageError as error:
        raise ValueError('no PGM, PNG, BMP or JPEG image') from error
    if width * height > FILES.image_pixels or max(width, height) > FILES.image_side:
        raise ValueError(
            f'{width} x {height} pixels: expected at most {FILES.image_pixels}, '
            f'and {FILES.image_side} on a side'
        )
    if start[:2] in _PLAIN_NETPBM:
        _check_comments(stream)
    stream.seek(0)


def _check_comments(stream: BinaryIO) -> None:
    """Raise ValueError where numbers of a plain netpbm image stand between too many comments.

    The decoder copies what follows at each of them.
    """
    stream.seek(0)
    count = 0
    while piece := stream.read(PIECE_BYTES):
        count += piece.count(b'#')
        if count > FILES.image_comments:
            raise ValueError(f'more than {FILES.image_comments} comments')


def _cells_of(image: 'Image.Image', shades: '_Shades') -> _ImageCells:
    levels, pixels_of = _decoder_of(image)
    table = shades.table(levels)
    counts = np.zeros(levels, dtype=np.int64)
    cells = np.empty((image.height, image.width), dtype=np.int8)
    for top in range(0, image.height, _STRIP_ROWS):
        end = min(top + _STRIP_ROWS, image.height)
        level, is_clear = pixels_of(image.crop((0, top, image.width, end)), shades.least_alpha)
        rows = np.where(is_clear, np.int8(UNKNOWN), table[level])
        cells[image.height - end : image.height - top] = rows[::-1]
        opaque = level[~np.broadcast_to(is_clear, level.shape)]
        counts += np.bincount(opaque, minlength=levels)
    return _ImageCells(cells, counts)


_Pixels = tuple[NDArray[np.uint16] | NDArray[np.uint8], NDArray[np.bool_]]


def _decoder_of(image: 'Image.Image') -> tuple[int, Callable[['Image.Image', int], _Pixels]]:
    """Number of levels of an image, and the function for levels and transparency of a strip."""
    if image.mode.startswith(('I', 'F')):
        return _GREYS_16, _deep_pixels
    if image.mode in ('1', 'L') and 'transparency' not in image.info:
        return _GREYS_8, _grey_pixels
    return _SUMS_OF_COLOURS, _colour_pixels


def _deep_pixels(strip: 'Image.Image', least_alpha: int) -> _Pixels:
    levels = np.clip(np.asarray(strip), 0, _GREYS_16 - 1).astype(np.uint16)
    return levels, np.asarray(levels == strip.info.get('transparency', -1))


def _grey_pixels(strip: 'Image.Image', least_alpha: int) -> _Pixels:
    return np.asarray(strip.convert('L')), np.zeros((), dtype=np.bool_)


def _colour_pixels(strip: 'Image.Image', least_alpha: int) -> _Pixels:
    pixels = np.asarray(strip.convert('RGBA'))
    return pixels[..., :3].sum(axis=-1, dtype=np.uint16), pixels[..., 3] < least_alpha


# Receives a line that the user of a map should know.
Report = Callable[[str], object]
_MARK = '# written by thinmap'
TAG = 'map_tag'  # key
# map_saver writes 0.25 beside the same grey values, but map_server takes each pixel below
# free_thresh as free, and unknown is 50/255 = 0.19608 dark: the map would lose what is unknown.
# Another grey value would not be unknown to readers that expect 205.
_KEEPS_UNKNOWN = 0.196


class _Grey(IntEnum):
    """Grey values of a trinary map, as map_saver writes them."""

    FREE = 254
    UNKNOWN = 205
    OCCUPIED = 0


def write_map(stem: Path | str, patch: GridPatch, tag: str = '') -> Path:
    """Write STEM.pgm and STEM.yaml (trinary mode); returns the path of the YAML file.

    tag: of the storey, which other readers of such files ignore.
    """
    from PIL import Image  # imported here: most processes never write or read a map

    stem = path_of(stem)
    require_type('patch', patch, GridPatch)
    grey = np.full(patch.shape, _Grey.UNKNOWN, dtype=np.uint8)
    grey[patch.free] = _Grey.FREE
    grey[patch.occupied] = _Grey.OCCUPIED
    image = stem.with_name(stem.name + '.pgm')
    description = stem.with_name(stem.name + '.yaml')
    with atomic_write(image) as aside:
        Image.fromarray(grey[::-1]).save(aside, format='PPM')
        # The image is renamed last: if the disk is full, the old map remains unchanged.
        description_of = _description(image.name, patch) | ({TAG: tag} if tag else {})
        content = yaml.safe_dump(description_of, sort_keys=False)
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
        'free_thresh': _KEEPS_UNKNOWN,
    }


def warn(text: str) -> None:
    """Report a line on a map as a Python warning."""
    warnings.warn(text, stacklevel=3)


def read_map(
    path: Path | str,
    folder: Path | None = None,
    report: Report = warn,
    *,
    keeps_unknown: bool = False,
) -> GridPatch:
    """Read a map from its YAML file, in the modes trinary, scale and raw, as map_server does.

    folder: if given, the image must be inside of it. Where free_thresh makes the grey free that
    map_saver writes for unknown, a line is reported; keeps_unknown: and the grey is unknown.
    Raises InputError with file, key, value and expectation. A map with a yaw in its origin is
    resampled.
    """
    path = path_of(path)
    content = read_texts(path, 'a map_server YAML file')
    image = _image_of(path, content, folder)
    resolution = _resolution(path, content)
    origin = _origin(path, content)
    shades = _Shades.of(path, content)
    read = _read_image(path, image, shades)
    if freed := shades.freed_unknown(read.counts):
        report(shades.freed_text(path, freed, keeps_unknown))
        if keeps_unknown:
            read = _read_image(path, image, replace(shades, keeps_unknown=True))
    return aligned_patch(origin, resolution, read.cells, FILES.image_pixels)


def read_tag(path: Path) -> str:
    """The tag of the storey of a map, from its YAML file; '' for none. Raises InputError."""
    tag = read_texts(path, 'a map_server YAML file').get(TAG, '')
    if not isinstance(tag, str):
        raise InputError(f'{path}: {TAG} = {quoted(tag)}: expected a text')
    return checked_tag(f'{path}: {TAG}', tag)


def read_resolution(path: Path) -> float:
    """Edge of a cell (m) of a map, from its YAML file. Raises InputError as `read_map`."""
    return _resolution(path, read_texts(path, 'a map_server YAML file'))


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
    path: Path, content: dict[str, Any], key: str, low: float, high: float, default: str = ''
) -> float:
    text = content.get(key, default)
    try:
        value = number_of(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise InputError(f'{path}: {key}: {quoted(text)}: expected a number from {low} to {high}')
    return value


def _is_negated(path: Path, content: dict[str, Any]) -> bool:
    try:
        return boolean_of(content.get('negate', '0'))
    except ValueError as error:
        raise InputError(f'{path}: negate: {error}') from error


def _origin(path: Path, content: dict[str, Any]) -> Array:
    value = content.get('origin')
    try:
        numbers = [number_of(text) for text in value] if isinstance(value, list) else []
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(abs(number) <= MAX_COORDINATE_M for number in numbers):
        raise InputError(f'{path}: origin: {quoted(value)}: expected [x, y, yaw] in m, m, rad')
    return se2.pose(*numbers)


class _Mode(StrEnum):
    """What the grey of a pixel means, by map_server."""

    TRINARY = 'trinary'
    SCALE = 'scale'
    RAW = 'raw'

    @staticmethod
    def of(path: Path, content: dict[str, Any]) -> '_Mode':
        name = content.get('mode', _Mode.TRINARY)
        if not isinstance(name, str) or name.lower() not in list(_Mode):
            raise InputError(f'{path}: mode: {quoted(name)}: expected {", ".join(_Mode)}')
        return _Mode(name.lower())


@dataclass(frozen=True)
class _Shades:
    """Conversion of levels, from black to white, to cells; keeps_unknown as in `read_map`.

    Source: loadMapFromFile in map_io.cpp of nav2_map_server (Jazzy). It averages alpha with the
    colours in mode trinary, so that a transparent pixel can be a wall: here it is unknown.
    """

    occupied: float
    free: float
    mode: _Mode
    negate: bool
    keeps_unknown: bool = False

    @staticmethod
    def of(path: Path, content: dict[str, Any]) -> '_Shades':
        occupied = _number(path, content, 'occupied_thresh', 0.0, 1.0, default='0.65')
        free = _number(path, content, 'free_thresh', 0.0, 1.0, default='0.25')
        mode = _Mode.of(path, content)
        if not free < occupied:
            expected = f'expected less than occupied_thresh ({occupied})'
            raise InputError(f'{path}: free_thresh: {free}: {expected}')
        return _Shades(occupied, free, mode, _is_negated(path, content))

    @property
    def least_alpha(self) -> int:
        """Pixels with a smaller alpha, of 255, are unknown: in mode scale all but opaque ones."""
        return 255 if self.mode is _Mode.SCALE else 1

    def freed_unknown(self, counts: NDArray[np.int64]) -> int:
        """Number of pixels of map_saver's unknown that are free, of the counts of all levels.

        0 in a picture whose grey is mostly another one.
        """
        levels = len(counts)
        unknown = self._level(_Grey.UNKNOWN, levels)
        ends = (self._level(_Grey.OCCUPIED, levels), self._level(_Grey.FREE, levels))
        grey = int(counts[min(ends) + 1 : max(ends)].sum())
        is_free = 0 <= self.table(levels)[unknown] <= FREE_AT_MOST
        return int(counts[unknown]) if is_free and 2 * counts[unknown] > grey else 0

    def freed_text(self, path: Path, count: int, keeps_unknown: bool) -> str:
        """A line on what becomes of map_saver's unknown, and what to do about it."""
        grey = 255 - _Grey.UNKNOWN if self.negate else _Grey.UNKNOWN
        remedy = f'free_thresh: {_KEEPS_UNKNOWN}'
        if self.mode is _Mode.SCALE:
            remedy = f'mode: trinary with {remedy}'
        cells = f'{path}: {count} cells of grey {grey}, which map_saver writes for unknown,'
        if keeps_unknown:
            return f'{cells} are unknown here, but free in map_server: {remedy} in that file'
        return f'{cells} are free, as in map_server: {remedy} in that file keeps them unknown'

    def _level(self, grey: int, levels: int) -> int:
        """The level of a grey of 255."""
        level = grey * (levels - 1) // 255
        return levels - 1 - level if self.negate else level

    def table(self, levels: int) -> NDArray[np.int8]:
        """Cell value of each level from 0 to levels - 1."""
        shade = np.arange(levels) / (levels - 1)
        darkness = shade if self.negate else 1.0 - shade
        cells = np.full(levels, UNKNOWN, dtype=np.int8)
        if self.mode is _Mode.RAW:
            values = np.floor(255.0 * shade + 0.5)
            known = values <= 100.0
            cells[known] = values[known]
            return cells
        if self.mode is _Mode.SCALE:
            share = np.clip((darkness - self.free) / (self.occupied - self.free), 0.0, 1.0)
            cells = np.rint(100.0 * share).astype(np.int8)
        cells[darkness < self.free] = 0
        cells[darkness > self.occupied] = 100
        if self.keeps_unknown:
            cells[self._level(_Grey.UNKNOWN, levels)] = UNKNOWN
        return cells


def _read_image(path: Path, image: Path, shades: _Shades) -> _ImageCells:
    """Cells of an image. Raises InputError where it cannot be read."""
    try:
        return _read_cells(image, shades)
    except Exception as error:  # Pillow raises many types for corrupt images
        reason = getattr(error, 'strerror', None) or one_line_reason(error)
        raise InputError(f'{image}: {reason}: expected an image that {path} names') from error
