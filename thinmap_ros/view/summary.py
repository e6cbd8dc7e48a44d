"""The summary picture of a run: map, regions, graph and paths, with legend and scale bar."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import (
    InputError,
    did_you_mean,
    quoted,
    require_type,
    with_known_keywords,
)
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.core.topology.regions import RegionKind, RegionMap
from thinmap_ros.core.topology.segmentation import WALL_MARGIN_M, RegionConfig, find_regions
from thinmap_ros.files.safe import atomic_write
from thinmap_ros.view import palette
from thinmap_ros.view.figures import DPI, draw_graph, draw_hidden_areas, draw_map, draw_shades

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from thinmap_ros.view.map_figure import MapFigure

# The largest side of a drawn map, cells: a cell of a smaller size than a pixel may vanish.
_MAX_CELLS = 1100
Cell = TypeVar('Cell', np.bool_, np.int32)


class DrawnCells(NamedTuple):
    """Free and occupied cells (H, W); the others are unknown."""

    free: NDArray[np.bool_]
    occupied: NDArray[np.bool_]


def reduction(shape: tuple[int, int]) -> int:
    """Cells of a map per side of a drawn cell."""
    return -(-max(shape) // _MAX_CELLS)


def reduced(cells: DrawnCells, factor: int) -> DrawnCells:
    """Cells in blocks: a block is occupied if any of its cells is, and else free if any is."""
    occupied = block_maximum(cells.occupied, factor)
    return DrawnCells(block_maximum(cells.free, factor) & ~occupied, occupied)


def block_maximum(cells: NDArray[Cell], factor: int) -> NDArray[Cell]:
    """Greatest value in each block of factor x factor cells."""
    if factor == 1:
        return cells
    rows, cols = (-(-count // factor) for count in cells.shape)
    padded = np.zeros((rows * factor, cols * factor), dtype=cells.dtype)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    blocks: NDArray[Cell] = padded.reshape(rows, factor, cols, factor).max(axis=(1, 3))
    return blocks


_UNKNOWN = '#CCCCCC'
_FREE = '#FFFFFF'
_WALL = '#000000'
_BOUNDARY = '#777777'
_NO_POINTS = np.empty((0, 2))
_ELLIPSIS = '…'


@dataclass(frozen=True)
class _Layout:
    """Sizes of the picture.

    long_in: longer side of the map, shortest_in: least width and height, inches; font_pt: of all
    text; title_chars: of a longer title only the beginning is shown; smallest_m: least side of the
    area that is shown; bar_share: longest scale bar, of the width; bar_above_in: its height above
    the map; legend_in: width and height of an entry; margins_in: width and height
    of labels and title; dense_nodes: nodes per square inch above which they are drawn smaller.
    """

    dpi: int
    long_in: float
    shortest_in: tuple[float, float]
    font_pt: float
    title_chars: int
    smallest_m: float
    bar_share: float
    bar_above_in: float
    legend_in: tuple[float, float]
    margins_in: tuple[float, float]
    dense_nodes: float


_LAYOUT = _Layout(
    dpi=160,
    long_in=7.0,
    shortest_in=(4.0, 1.2),
    font_pt=11.0,
    title_chars=70,
    smallest_m=1.0,
    bar_share=0.3,
    bar_above_in=0.07,
    legend_in=(2.0, 0.24),
    margins_in=(0.8, 1.25),
    dense_nodes=4.0,
)


def summary_figure(
    path: Path,
    patch: GridPatch,
    topology: TopologicalMap,
    estimated: Array,
    true: Array | None = None,
    title: str = '',
    regions: RegionMap | None = None,
    hidden: Array | None = None,
    apart: Array = _NO_POINTS,
    robots: Mapping[str, Array] | None = None,
) -> None:
    """Write a PNG of `make_figure`."""
    figure = make_figure(patch, topology, estimated, true, title, regions, hidden, apart, robots)
    with atomic_write(path) as aside:
        figure.save(aside)


def make_figure(
    patch: GridPatch,
    topology: TopologicalMap,
    estimated: Array = _NO_POINTS,
    true: Array | None = None,
    title: str = '',
    regions: RegionMap | None = None,
    hidden: Array | None = None,
    apart: Array = _NO_POINTS,
    robots: Mapping[str, Array] | None = None,
    size_in: float = _LAYOUT.long_in,
    with_cells: bool = True,
) -> 'MapFigure':
    """A figure of map, skeleton, nodes by kind, paths (N, 2 or more), as estimated and driven.

    regions: of the grid, in pale colours; hidden (N, 3): positions, m, and hidden area, m2, that is
    expected there; apart (N, 2): scan points of pieces of map whose place is unknown; robots: paths
    (N, 2 or more) of several robots by name; size_in: longer side of the map, inches; with_cells:
    whether the map is drawn, and not its place alone.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from thinmap_ros.view.map_figure import MapFigure

    area = shown_area(patch, apart)
    width, height = _map_inches(area, size_in)
    with matplotlib.rc_context({'font.size': _LAYOUT.font_pt}):
        figure = MapFigure(dpi=_LAYOUT.dpi, layout='constrained')
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        surfaces: dict[str, str] = {}
        if with_cells:
            axes.set_facecolor(_UNKNOWN)
            surfaces = _draw_cells(axes, patch, regions)
        _draw_apart(axes, apart)
        _draw_paths(axes, estimated, true)
        _draw_robots(axes, robots or {})
        is_dense = len(topology.nodes) > _LAYOUT.dense_nodes * width * height
        draw_graph(axes, topology, 3.5 if is_dense else 5.0)
        if hidden is not None and len(hidden):
            draw_hidden_areas(axes, hidden)
        left, right, bottom, top = area
        axes.set(
            xlabel='x (m)', ylabel='y (m)', aspect='equal', xlim=(left, right), ylim=(bottom, top)
        )
        _draw_scale_bar(axes, right - left, height)
        figure.suptitle(shortened(title), parse_math=False)
        _draw_legend(figure, axes, surfaces, (width, height))
    return figure


def shown_area(patch: GridPatch, points: Array = _NO_POINTS) -> tuple[float, float, float, float]:
    """Least and greatest x, and y, m, of a picture that is neither tiny nor a strip.

    It shows the map and points (N, 2), m.
    """
    rows, cols = patch.shape
    frame = patch.frame
    low = np.array([frame.origin_x, frame.origin_y])
    high = low + frame.resolution * np.array([cols, rows])
    low = np.vstack([low, points]).min(axis=0)
    high = np.vstack([high, points]).max(axis=0)
    sides = np.maximum(high - low, _LAYOUT.smallest_m)
    m_per_in = float(sides.max()) / _LAYOUT.long_in
    width, height = (
        max(side, least * m_per_in) for side, least in zip(sides, _LAYOUT.shortest_in, strict=True)
    )
    x, y = (0.5 * (low + high)).tolist()
    return x - 0.5 * width, x + 0.5 * width, y - 0.5 * height, y + 0.5 * height


def scale_bar_m(width_m: float) -> float:
    """Length of the scale bar: 1, 2 or 5 times a power of ten."""
    longest = _LAYOUT.bar_share * width_m
    power = 10.0 ** np.floor(np.log10(longest))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= longest * 1.0001))


def shortened(title: str) -> str:
    """A title in one line, cut off where it is too long."""
    line = ' '.join(title.split())
    most = _LAYOUT.title_chars
    return line if len(line) <= most else line[: most - 1] + _ELLIPSIS


def _map_inches(area: tuple[float, float, float, float], size_in: float) -> tuple[float, float]:
    left, right, bottom, top = area
    scale = size_in / max(right - left, top - bottom)
    return (right - left) * scale, (top - bottom) * scale


def _draw_cells(axes: 'Axes', patch: GridPatch, regions: RegionMap | None) -> dict[str, str]:
    """Draw the cells; returns the colour of each kind of surface by its name in the legend."""
    factor = reduction(patch.shape)
    cell_m = factor * patch.frame.resolution
    cells = reduced(DrawnCells(patch.free, patch.occupied), factor)
    shade = np.empty((*cells.free.shape, 3), dtype=np.uint8)
    shade[:] = palette.rgb(_UNKNOWN)
    shade[cells.free] = palette.rgb(_FREE)
    surfaces = {'wall': _WALL} if cells.occupied.any() else {}
    surfaces['unknown'] = _UNKNOWN
    labels = None
    if regions is not None and regions.regions:
        labels = block_maximum(regions.labels.astype(np.int32), factor)
        labels = _spread_labels(labels, cells.free, round(WALL_MARGIN_M / cell_m))
        for kind in RegionKind:
            ids = [region.id for region in regions.regions.values() if region.kind == kind]
            colour = palette.REGIONS[kind][0]
            if ids:
                shade[np.isin(labels, ids)] = palette.rgb(colour)
                surfaces[kind.name.lower()] = colour
    if (shade[cells.free] == 255).all(axis=1).any():
        surfaces['free'] = _FREE
    shade[cells.occupied] = palette.rgb(_WALL)
    draw_shades(axes, shade, patch.frame, cell_m)
    if labels is not None:
        _draw_boundaries(axes, labels, patch.frame, cell_m)
    return surfaces


def _spread_labels(
    labels: NDArray[np.int32], free: NDArray[np.bool_], margin: int
) -> NDArray[np.int32]:
    """Labels (H, W) of all free cells that are at most some cells from a region, 0 elsewhere."""
    from scipy.ndimage import distance_transform_cdt

    away, nearest = distance_transform_cdt(labels == 0, metric='chessboard', return_indices=True)
    spread = labels[nearest[0], nearest[1]]
    return np.where(free & (away <= margin), spread, 0)


def _draw_boundaries(
    axes: 'Axes', labels: NDArray[np.int32], frame: GridFrame, cell_m: float
) -> None:
    """Draw the borders between cells of different regions."""
    from matplotlib.collections import LineCollection

    segments = []
    for here, there, along in (
        (labels[:, :-1], labels[:, 1:], (0.0, 1.0)),
        (labels[:-1], labels[1:], (1.0, 0.0)),
    ):
        cells = np.argwhere((here != there) & (here > 0) & (there > 0))[:, ::-1]
        starts = cells + (along[1], along[0])
        segments.append(np.stack([starts, starts + along], axis=1))
    ends = np.concatenate(segments) * cell_m + (frame.origin_x, frame.origin_y)
    if len(ends):
        lines = LineCollection(
            list(ends), colors=_BOUNDARY, linewidths=1.2, label='region boundary', zorder=1.5
        )
        axes.add_collection(lines)


def _draw_apart(axes: 'Axes', points: Array) -> None:
    """Draw the scan points of pieces of map whose place is unknown."""
    if len(points):
        style: dict[str, Any] = {'linestyle': '', 'marker': '.', 'markersize': 1.5}
        axes.plot(*points.T, color=palette.APART, label='place unknown', zorder=1.7, **style)


def _draw_paths(axes: 'Axes', estimated: Array, true: Array | None) -> None:
    """Draw the estimated path, wide, and the driven one over it, thin."""
    if len(estimated):
        axes.plot(
            *estimated[:, :2].T,
            color=palette.ESTIMATE,
            linewidth=2.6,
            solid_capstyle='round',
            label='path, estimated',
            zorder=2,
        )
    if true is not None and len(true):
        axes.plot(
            *true[:, :2].T, color=palette.TRUTH, linewidth=0.9, label='path, driven', zorder=3
        )
    if len(estimated):
        _draw_ends(axes, estimated, palette.TRUTH, ('start', 'end'))


def _draw_robots(axes: 'Axes', robots: Mapping[str, Array]) -> None:
    """Draw the path of each robot in a colour of its own, from a star to a cross."""
    for number, (name, path) in enumerate(robots.items()):
        colour = palette.ROBOTS[number % len(palette.ROBOTS)]
        axes.plot(*path[:, :2].T, color=colour, linewidth=1.5, label=name, zorder=3)
        _draw_ends(axes, path, colour)


def _draw_ends(
    axes: 'Axes', path: Array, colour: str, labels: tuple[str | None, str | None] = (None, None)
) -> None:
    """Draw a star where a path (N, 2 or more) begins, and a cross where it ends."""
    style: dict[str, Any] = {
        'color': 'white',
        'markeredgecolor': colour,
        'markeredgewidth': 1.2,
        'linestyle': '',
        'zorder': 6,
    }
    axes.plot(*path[0, :2], marker='*', markersize=14, label=labels[0], **style)
    axes.plot(*path[-1, :2], marker='X', markersize=9, label=labels[1], **style)


def _draw_scale_bar(axes: 'Axes', width_m: float, height_in: float) -> None:
    """Draw a bar of a round length above the map, at the right."""
    length = scale_bar_m(width_m)
    share = length / width_m
    style: dict[str, Any] = {'transform': axes.transAxes, 'clip_on': False}
    above = _LAYOUT.bar_above_in / height_in
    axes.plot(
        [1.0 - share, 1.0],
        [1.0 + above, 1.0 + above],
        color='black',
        linewidth=3.0,
        solid_capstyle='butt',
        **style,
    )
    axes.text(
        1.0 - 0.5 * share, 1.0 + 1.8 * above, f'{length:g} m', ha='center', va='bottom', **style
    )


def _draw_legend(
    figure: 'Figure', axes: 'Axes', surfaces: dict[str, str], map_in: tuple[float, float]
) -> None:
    """Draw the legend below the map, and set the size of the figure to hold both."""
    from matplotlib.patches import Patch

    handles: list[Any] = [
        Patch(facecolor=colour, edgecolor='#555555', linewidth=0.5, label=name)
        for name, colour in surfaces.items()
    ]
    handles += axes.get_legend_handles_labels()[0]
    width = map_in[0] + _LAYOUT.margins_in[0]
    columns = max(2, int(width / _LAYOUT.legend_in[0]))
    rows = -(-len(handles) // columns)
    figure.set_size_inches(width, map_in[1] + _LAYOUT.margins_in[1] + rows * _LAYOUT.legend_in[1])
    figure.legend(
        handles=handles,
        loc='outside lower center',
        ncols=columns,
        fontsize=_LAYOUT.font_pt,
        frameon=False,
        handlelength=1.6,
    )


_PANEL_IN = 5.0
_NODE_PT = 2.5


def merged_figure(path: Path, maps: Sequence[tuple[str, GridPatch, TopologicalMap]]) -> None:
    """Write a PNG: maps side by side, each with a title and its topological map."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    size = (_PANEL_IN * len(maps), _PANEL_IN)
    figure = Figure(figsize=size, dpi=DPI, layout='constrained')
    FigureCanvasAgg(figure)
    for number, (title, patch, topology) in enumerate(maps, 1):
        axes = figure.add_subplot(1, len(maps), number)
        draw_map(axes, patch)
        draw_graph(axes, topology, _NODE_PT)
        axes.set(xlabel='x (m)', ylabel='y (m)', aspect='equal')
        axes.set_title(title, parse_math=False)
    with atomic_write(path) as aside:
        figure.savefig(aside, format='png', metadata={'Software': None})


# What `plot` draws, the lowest first.
LAYERS = ('map', 'regions', 'graph', 'path')
_DEFAULT_LAYERS = ('map', 'graph', 'path')
_LARGEST_IN = 40.0


@with_known_keywords
def plot(
    shown: Any,
    topology: TopologicalMap | None = None,
    title: str = '',
    *,
    layers: Sequence[str] = _DEFAULT_LAYERS,
    size_in: float = _LAYOUT.long_in,
    true: Any = None,
) -> 'MapFigure':
    """A matplotlib figure of a Pipeline, with its graph and path, or of a GridPatch with a graph.

    layers: of map, regions (rooms and corridors, on the map), graph, and path: the final poses of
    all scans. size_in: longer side of the map, inches. true: the path driven (N, 2 or more), m, or
    StampedPoses. `figure.savefig(path)` saves it; a notebook shows it. Raises InputError for
    anything else.
    """
    driven = _points_of('true', true)
    _check_look(layers, size_in)
    if topology is not None:
        require_type('topology', topology, TopologicalMap)
    path = _NO_POINTS
    regions = None
    if isinstance(shown, GridPatch):
        patch = shown
        graph = topology or TopologicalMap()
        config = RegionConfig()
    elif hasattr(shown, 'grid') and hasattr(shown, 'trajectory'):
        patch = shown.grid.known_area()
        graph = topology or shown.topology.map
        config = RegionConfig(robot_radius_m=shown.config.topology.robot_radius_m)
        path = shown.trajectory.final.poses
    else:
        raise InputError(f'plot: a {type(shown).__name__}: expected a Pipeline or a GridPatch')
    if 'regions' in layers:
        regions = find_regions(patch, config)
    return make_figure(
        patch,
        graph if 'graph' in layers else TopologicalMap(),
        path if 'path' in layers else _NO_POINTS,
        driven,
        title,
        regions,
        size_in=size_in,
        with_cells='map' in layers or 'regions' in layers,
    )


def _points_of(what: str, value: Any) -> Array | None:
    """Points (N, 2) of a path of a caller; None: none. Raises InputError for anything else."""
    if value is None:
        return None
    try:
        points = np.asarray(getattr(value, 'poses', value), dtype=np.float64)
    except (TypeError, ValueError):
        points = np.empty(0)
    if points.ndim != 2 or points.shape[1] < 2 or not np.isfinite(points).all():
        raise InputError(f'{what} = {quoted(value)}: expected points (N, 2) or poses (N, 3), m')
    return points[:, :2]


def _check_look(layers: Sequence[str], size_in: float) -> None:
    """Raise InputError for layers that do not exist, and a size that is no size."""
    given = [layers] if isinstance(layers, str) or not isinstance(layers, Sequence) else layers
    for layer in given:
        if layer not in LAYERS:
            meant = did_you_mean(str(layer), LAYERS)
            expected = ', '.join(LAYERS)
            raise InputError(f'layers: {quoted(layer)}{meant}: expected some of {expected}')
    if not isinstance(size_in, float | int) or not 1.0 <= size_in <= _LARGEST_IN:
        raise InputError(f'size_in = {quoted(size_in)}: expected 1 to {_LARGEST_IN:g} inches')
