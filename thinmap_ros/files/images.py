"""Reads images of maps within limits, and converts them to cells strip by strip.

Formats: PGM (or another netpbm format), PNG, BMP and JPEG. The header is read from the first bytes
of the file, and the size that it gives is checked before pixels are decoded. Besides the decoded
image and its cells, the conversion takes the memory of one strip of rows.
"""

import warnings
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import UNKNOWN
from thinmap_ros.files.limits import FILES, PIECE_BYTES
from thinmap_ros.files.regular_files import open_regular_file

if TYPE_CHECKING:
    from PIL import Image

# Readers of other formats run programs, or decode before they check the size.
_FORMATS = ('PPM', 'PNG', 'BMP', 'JPEG')
_PLAIN_NETPBM = (b'P1', b'P2', b'P3')
_GREYS_8 = 1 << 8
_GREYS_16 = 1 << 16
_STRIP_ROWS = 64


def read_cells(path: Path, table_of: Callable[[int], NDArray[np.int8]]) -> NDArray[np.int8]:
    """Cells (H, W) of an image, its bottom row first; transparent pixels are unknown.

    table_of: cell value of each grey value, for a number of grey values.
    Raises OSError, ValueError, or another error of the decoder for an image that cannot be read.
    """
    from PIL import Image  # imported here: most processes never read a map

    # Above its own, larger limit Pillow only warns: here this is an error.
    with warnings.catch_warnings(), open_regular_file(path) as stream:
        warnings.simplefilter('error', Image.DecompressionBombWarning)
        _check_header(stream)
        with Image.open(stream, formats=_FORMATS) as image:
            image.load()
            return _cells_of(image, table_of)


def _check_header(stream: BinaryIO) -> None:
    """Check the size of an image, of which only the first bytes are read.

    Raises ValueError, or another error of the decoder where the header does not end in them.
    """
    from PIL import Image

    start = stream.read(FILES.image_header_bytes)
    with Image.open(BytesIO(start), formats=_FORMATS) as image:
        width, height = image.size
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


def _cells_of(
    image: 'Image.Image', table_of: Callable[[int], NDArray[np.int8]]
) -> NDArray[np.int8]:
    is_deep = image.mode.startswith(('I', 'F'))
    table = table_of(_GREYS_16 if is_deep else _GREYS_8)
    cells = np.empty((image.height, image.width), dtype=np.int8)
    for top in range(0, image.height, _STRIP_ROWS):
        end = min(top + _STRIP_ROWS, image.height)
        strip = image.crop((0, top, image.width, end))
        rows = _deep_rows(strip, table) if is_deep else _rows(strip, table)
        cells[image.height - end : image.height - top] = rows[::-1]
    return cells


def _deep_rows(strip: 'Image.Image', table: NDArray[np.int8]) -> NDArray[np.int8]:
    greys = np.clip(np.asarray(strip), 0, _GREYS_16 - 1).astype(np.uint16)
    rows: NDArray[np.int8] = table[greys]
    return rows


def _rows(strip: 'Image.Image', table: NDArray[np.int8]) -> NDArray[np.int8]:
    rows: NDArray[np.int8] = table[np.asarray(strip.convert('L'))]
    if 'A' in strip.getbands():
        rows[np.asarray(strip.getchannel('A')) == 0] = UNKNOWN
    return rows
