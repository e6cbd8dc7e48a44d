"""Pictures made small."""

from pathlib import Path

from PIL import Image

from thinmap_ros.files.atomic import written_aside

_COLOURS = 64


def write_small_png(source: Path, target: Path) -> None:
    """Copy a PNG with so few colours that it takes a third of the space."""
    with Image.open(source) as picture, written_aside(target) as aside:
        small = picture.convert('RGB').quantize(_COLOURS, dither=Image.Dither.NONE)
        small.save(aside, format='PNG', optimize=True)
