"""Reads images of maps within limits, and converts them to cells strip by strip.

Formats: PGM (or another netpbm format), PNG, BMP and JPEG. The header is read from the first bytes
of the file, and the size that it gives is checked before pixels are decoded. Besides the decoded
image and its cells, the conversion takes the memory of one strip of rows.

The level of a pixel is the sum of red, green and blue, as map_server takes their mean; the
luminance of an image would make a green wall lighter than a red one.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import UNKNOWN
from thinmap_ros.files.safe import FILES, PIECE_BYTES, open_regular_file

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
class CellRule:
    """How the pixels of an image become cells.

    table_of: cell value of each level, for a number of levels from black to white. least_alpha:
    pixels with a smaller alpha, of 255, are unknown.
    """

    table_of: Callable[[int], NDArray[np.int8]]
    least_alpha: int = 1


@dataclass(frozen=True, eq=False)
class ImageCells:
    """Cells of an image (H, W), its bottom row first, and how many pixels have which level.

    counts (levels,): from black to white, without pixels that are unknown as they are transparent.
    """

    cells: NDArray[np.int8]
    counts: NDArray[np.int64]


def read_cells(path: Path, rule: CellRule) -> ImageCells:
    """Read the cells of an image.

    Raises OSError, ValueError, or another error of the decoder for an image that cannot be read.
    """
    from PIL import Image  # imported here: most processes never read a map

    # Above its own, larger limit Pillow only warns: here this is an error.
    with warnings.catch_warnings(), open_regular_file(path) as stream:
        warnings.simplefilter('error', Image.DecompressionBombWarning)
        _check_header(stream)
        with Image.open(stream, formats=_FORMATS) as image:
            image.load()
            return _cells_of(image, rule)


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


def _cells_of(image: 'Image.Image', rule: CellRule) -> ImageCells:
    levels, pixels_of = _decoder_of(image)
    table = rule.table_of(levels)
    counts = np.zeros(levels, dtype=np.int64)
    cells = np.empty((image.height, image.width), dtype=np.int8)
    for top in range(0, image.height, _STRIP_ROWS):
        end = min(top + _STRIP_ROWS, image.height)
        level, is_clear = pixels_of(image.crop((0, top, image.width, end)), rule.least_alpha)
        rows = np.where(is_clear, np.int8(UNKNOWN), table[level])
        cells[image.height - end : image.height - top] = rows[::-1]
        opaque = level[~np.broadcast_to(is_clear, level.shape)]
        counts += np.bincount(opaque, minlength=levels)
    return ImageCells(cells, counts)


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
