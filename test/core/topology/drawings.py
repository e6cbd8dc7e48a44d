"""Small maps drawn as text, and real maps, for the tests of the topological map."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch

RESOLUTION = 0.1
STATES = {'#': 100, '.': 0, '?': UNKNOWN}


def patch_of(cells: np.ndarray, origin: tuple[float, float] = (0.0, 0.0)) -> GridPatch:
    return GridPatch(GridFrame(*origin, RESOLUTION), cells.astype(np.int8))


def drawn(*lines: str, scale: int = 10) -> GridPatch:
    """A map with `scale` cells to a character, the first line at the top (largest y)."""
    cells = np.array([[STATES[sign] for sign in line] for line in lines])[::-1]
    return patch_of(cells.repeat(scale, axis=0).repeat(scale, axis=1))


def place(col: float, row: float, lines: int, scale: int = 10) -> tuple[float, float]:
    """World point at the centre of a character, (col, row) from the top left."""
    return (col + 0.5) * scale * RESOLUTION, (lines - row - 0.5) * scale * RESOLUTION


def world(folder: Path, name: str) -> tuple[GridPatch, tuple[float, float]]:
    """A real floor plan, and a start position."""
    picture = np.array(Image.open(folder / 'worlds' / f'{name}.png'))[::-1]
    start = json.loads((folder / 'worlds' / 'worlds.json').read_text())[name]['starts'][0]
    return patch_of(np.where(picture > 250, 0, 100)), (start[0], start[1])
