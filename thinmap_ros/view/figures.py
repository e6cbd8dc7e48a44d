"""Figures of maps, and size reduction of PNG files."""

import math
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap
from thinmap_ros.files.safe import atomic_write
from thinmap_ros.view import palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DPI = 110
_GREY = 204  # of 255: unknown cells
_SMALL_COLOURS = 64
# Each kind of node has its own shape and colour.
_MARKERS = {NodeKind.END: 'o', NodeKind.BRANCH: 's', NodeKind.CORNER: '^'}


def draw_map(axes: 'Axes', patch: GridPatch) -> None:
    """Draw the cells of a grid: free white, occupied black, unknown grey."""
    shade = np.full((*patch.shape, 3), _GREY, dtype=np.uint8)
    shade[patch.free] = 255
    shade[patch.occupied] = 0
    draw_shades(axes, shade, patch.frame, patch.frame.resolution)


def draw_shades(axes: 'Axes', shade: NDArray[np.uint8], frame: GridFrame, cell_m: float) -> None:
    """Draw cells of a size in their colours (H, W, 3), from the origin of a frame on."""
    rows, cols = shade.shape[:2]
    x = frame.origin_x + cell_m * np.arange(cols + 1)
    y = frame.origin_y + cell_m * np.arange(rows + 1)
    # Not by imshow: it takes some 90 bytes per pixel.
    axes.pcolormesh(x, y, shade, antialiased=False, rasterized=True)


def draw_hidden_areas(axes: 'Axes', hidden: Array) -> None:
    """Draw a circle of each expected hidden area (N, 3; x, y in m, m2) at its position."""
    from matplotlib.patches import Circle

    for i, (x, y, area_m2) in enumerate(hidden.tolist()):
        label = 'expected hidden area' if i == 0 else None
        radius_m = math.sqrt(area_m2 / math.pi)
        axes.add_patch(
            Circle(
                (x, y),
                radius_m,
                facecolor='none',
                edgecolor=palette.HIDDEN,
                linestyle='--',
                linewidth=1.5,
                label=label,
                zorder=5,
            )
        )


def draw_graph(axes: 'Axes', topology: TopologicalMap, size: float = 5.0) -> None:
    """Draw the paths of the edges and the nodes by kind, with markers of a size in points."""
    for i, edge in enumerate(topology.edges.values()):
        label = 'skeleton' if i == 0 else None
        axes.plot(
            edge.path[:, 0],
            edge.path[:, 1],
            '-',
            color=palette.EDGE,
            linewidth=2.0,
            label=label,
            zorder=4,
        )
    for kind, marker in _MARKERS.items():
        positions = [n.position for n in topology.nodes.values() if n.kind == kind]
        places = np.array(positions).reshape(-1, 2)
        if len(places):
            label = f'{kind.name.lower()} nodes'
            axes.plot(
                *places.T,
                marker,
                color=palette.NODES[kind],
                markersize=size,
                markeredgecolor='black',
                markeredgewidth=0.4,
                linestyle='',
                label=label,
                zorder=5,
            )


def coverage_figure(path: Path, reports: list[dict[str, Any]]) -> None:
    """Write a PNG: coverage over distance by strategy, the mean of all runs in `reports`.

    Each report has its `curve`. A run's distance is given as a share of the mean distance of all
    strategies from the same world and start.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    lengths: dict[tuple[str, int], list[float]] = defaultdict(list)
    for report in reports:
        lengths[report['world'], report['start_number']].append(report['distance'])
    shares = np.linspace(0.0, 1.5, 151)
    curves: dict[str, list[Array]] = defaultdict(list)
    for report in reports:
        unit = max(float(np.mean(lengths[report['world'], report['start_number']])), 1e-9)
        _, along, coverage = np.array(report['curve']).T
        curves[report['strategy']].append(np.interp(shares * unit, along, coverage))
    figure = Figure(figsize=(8.0, 5.0), dpi=DPI, layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for strategy, runs in sorted(curves.items()):
        axes.plot(shares, 100.0 * np.mean(runs, axis=0), label=f'{strategy} ({len(runs)})')
    axes.set(
        xlabel='distance, of the mean of all strategies', ylabel='coverage (%)', ylim=(0.0, 101.0)
    )
    axes.legend(fontsize=8, frameon=False)
    with atomic_write(path) as aside:
        figure.savefig(aside, format='png', bbox_inches='tight')


def write_small_png(source: Path, target: Path) -> None:
    """Copy a PNG with a reduced palette: a third of the size."""
    from PIL import Image

    with Image.open(source) as picture, atomic_write(target) as aside:
        small = picture.convert('RGB').quantize(_SMALL_COLOURS, dither=Image.Dither.NONE)
        small.save(aside, format='PNG', optimize=True)
