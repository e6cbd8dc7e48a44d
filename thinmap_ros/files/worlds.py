"""World files: walls in a YAML file, or a map_server map."""

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.grid.patch import MIN_RESOLUTION_M, GridFrame, GridPatch
from thinmap_ros.core.se2 import MAX_COORDINATE_M, Array, pose
from thinmap_ros.files.occupancy_maps import read_map
from thinmap_ros.files.safe import FILES, path_of, read_mapping

_MARGIN_M = 0.2
_NUDGE_M = 1e-9
_FREE = 0
_SOLID = 100


def read_world(path: Path | str) -> tuple[str, GridPatch, Array]:
    """Name, map and start (3,) (NaN: none) of a YAML file.

    The file is a world (walls, solids, tour) or a map_server map (image).
    Raises InputError with file, key, value and expectation.
    """
    path = path_of(path)
    content = read_mapping(path, 'a world (walls, start) or a map (image, resolution, origin)')
    return _from_map(path, content) if 'image' in content else _from_drawing(path, content)


def read_tour(path: Path) -> Array:
    """Tour of a world: places (N, 2), m, in the order of visits from the start; may be empty.

    Raises InputError with file, value and expectation.
    """
    content = read_mapping(path, 'a world (walls, start) or a map (image, resolution, origin)')
    return _points(path, 'tour', content['tour'], 1) if 'tour' in content else np.empty((0, 2))


def read_starts(path: Path) -> Array:
    """Starts of several robots in a world, poses (N, 3); may be empty.

    Raises InputError with file, value and expectation.
    """
    content = read_mapping(path, 'a world (walls, start) or a map (image, resolution, origin)')
    drawn = content.get('starts', [])
    if not isinstance(drawn, list):
        raise InputError(f'{path}: starts: {quoted(drawn)}: expected a list of [x, y, theta]')
    poses = [_numbers(path, {'starts': start}, 'starts', 3) for start in drawn]
    return np.array([pose(*numbers) for numbers in poses]).reshape(-1, 3)


def _from_map(path: Path, content: dict[str, Any]) -> tuple[str, GridPatch, Array]:
    start = np.array([np.nan, np.nan, 0.0])
    if 'start' in content:
        start = pose(*_numbers(path, content, 'start', 3))
    return path.stem, read_map(path), start


def _numbers(path: Path, content: dict[str, Any], key: str, count: int) -> list[float]:
    value = content.get(key)
    try:
        numbers = [float(v) for v in (value if isinstance(value, list) else [value])]  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if len(numbers) != count or not all(math.isfinite(v) for v in numbers):
        expected = f'expected {count} finite number{"s" if count > 1 else ""}'
        raise InputError(f'{path}: {key}: {quoted(value)}: {expected}')
    return numbers


def _resolution(path: Path, content: dict[str, Any]) -> float:
    (resolution,) = _numbers(path, content, 'resolution', 1)
    if not MIN_RESOLUTION_M <= resolution <= 1.0:
        raise InputError(f'{path}: resolution: {resolution}: expected {MIN_RESOLUTION_M} to 1 m')
    return resolution


def _polylines(path: Path, content: dict[str, Any], key: str, fewest: int) -> list[Array]:
    drawn = content.get(key, [])
    if not isinstance(drawn, list):
        expected = 'expected a list of lists of points [x, y]'
        raise InputError(f'{path}: {key}: {quoted(drawn)}: {expected}')
    return [_points(path, f'{key}[{i}]', points, fewest) for i, points in enumerate(drawn)]


def _points(path: Path, what: str, drawn: object, fewest: int) -> Array:
    try:
        points = np.asarray(drawn, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        points = np.empty((0, 0))
    if (
        points.ndim != 2
        or points.shape[1:] != (2,)
        or len(points) < fewest
        or not np.isfinite(points).all()
    ):
        expected = f'expected at least {fewest} points [x, y]'
        raise InputError(f'{path}: {what}: {quoted(drawn)}: {expected}')
    return points


def _from_drawing(path: Path, content: dict[str, Any]) -> tuple[str, GridPatch, Array]:
    known = {'name', 'resolution', 'wall_thickness', 'start', 'starts', 'tour', 'walls', 'solids'}
    if unknown := set(content) - known:
        expected = ', '.join(sorted(known))
        raise InputError(f'{path}: unknown key {quoted(min(unknown))}: expected {expected}')
    resolution = _resolution(path, content)
    (thickness,) = _numbers(path, content, 'wall_thickness', 1)
    # Rays pass through thinner walls, between cells that touch only at a corner.
    if not 2.0 * resolution <= thickness <= 10.0:
        raise InputError(
            f'{path}: wall_thickness: {thickness}: '
            f'expected at least two cells ({2.0 * resolution} m)'
        )
    walls = _polylines(path, content, 'walls', 2)
    polygons = _polylines(path, content, 'solids', 3)
    polygons += [_wall_polygon(a, b, thickness) for wall in walls for a, b in pairwise(wall)]
    if not polygons:
        raise InputError(f'{path}: walls: expected at least one wall or solid')
    frame, shape = _frame_of(path, np.concatenate(polygons), resolution)
    cells = np.full(shape, _FREE, dtype=np.int8)
    for polygon in polygons:
        _fill(cells, frame, polygon)
    return _name(path, content), GridPatch(frame, cells), pose(*_numbers(path, content, 'start', 3))


def _name(path: Path, content: dict[str, Any]) -> str:
    name = content.get('name', path.stem)
    if not isinstance(name, str | int | float) or len(str(name)) > FILES.name_length:
        expected = f'expected a name of at most {FILES.name_length} characters'
        raise InputError(f'{path}: name: {quoted(name)}: {expected}')
    return str(name)


def _frame_of(path: Path, points: Array, resolution: float) -> tuple[GridFrame, tuple[int, int]]:
    """Frame and shape of a grid that contains all points; its lines pass through the origin."""
    farthest = float(np.abs(points).max())
    if farthest > MAX_COORDINATE_M:
        expected = f'expected at most {MAX_COORDINATE_M:g} m; is a point wrong?'
        raise InputError(f'{path}: point at {farthest:g} m: {expected}')
    low = np.floor((points.min(axis=0) - _MARGIN_M) / resolution)
    cols, rows = np.ceil((points.max(axis=0) + _MARGIN_M) / resolution) - low
    if not rows * cols <= FILES.world_cells:
        raise InputError(
            f'{path}: {rows:.0f} x {cols:.0f} cells: expected at most {FILES.world_cells}; '
            'is a point wrong?'
        )
    frame = GridFrame(float(low[0]) * resolution, float(low[1]) * resolution, resolution)
    return frame, (int(rows), int(cols))


def _fill(cells: NDArray[np.int8], frame: GridFrame, polygon: Array) -> None:
    """Set the cells whose centres lie in a polygon (N, 2) to occupied, by the even-odd rule."""
    # Without the offset, edges through cell centres are rounded to either side: walls of 4 to 6
    # cells.
    polygon = polygon - _NUDGE_M
    low = np.maximum(frame.cells_of(polygon.min(axis=0))[0], 0)
    high = frame.cells_of(polygon.max(axis=0))[0] + 1
    corners = frame.centres_of(np.array([low, high - 1]))
    x = np.linspace(corners[0, 0], corners[1, 0], high[1] - low[1])
    y = np.linspace(corners[0, 1], corners[1, 1], high[0] - low[0])[:, None]
    inside = np.zeros((y.size, x.size), dtype=np.bool_)
    for a, b in pairwise(np.vstack([polygon, polygon[:1]])):
        if a[1] != b[1]:
            crossing = a[0] + (y - a[1]) * (b[0] - a[0]) / (b[1] - a[1])
            inside ^= ((a[1] <= y) != (b[1] <= y)) & (x < crossing)
    cells[low[0] : high[0], low[1] : high[1]][inside] = _SOLID


def _wall_polygon(a: Array, b: Array, thickness: float) -> Array:
    """Corners (4, 2) of a wall from a to b, extended by half its thickness to close corners."""
    length = float(np.hypot(*(b - a)))
    along = (b - a) / length if length > 0.0 else np.array([1.0, 0.0])
    across = np.array([-along[1], along[0]]) * thickness / 2.0
    a = a - along * thickness / 2.0
    b = b + along * thickness / 2.0
    return np.array([a + across, b + across, b - across, a - across])
