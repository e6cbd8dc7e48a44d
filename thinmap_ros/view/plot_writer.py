"""Figures of `plots` drawn with matplotlib, as PNG and SVG.

The same figure gives the same bytes.
"""

from collections.abc import Iterable
from functools import singledispatch
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thinmap_ros.files.safe import atomic_write
from thinmap_ros.view import palette
from thinmap_ros.view.figures import DPI, draw_graph, draw_map
from thinmap_ros.view.plots import (
    Band,
    Bars,
    Curve,
    GraphLayer,
    MapLayer,
    Panel,
    Plot,
    Raster,
    RobotMarkers,
    Segments,
    TextLabels,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PAD = 0.1  # inches
_MANY = 2000  # maximum number of points, to limit the size of an SVG
# Text stays text in an SVG, and its ids do not change from run to run.
_SETTINGS: Any = {
    'svg.fonttype': 'none',
    'svg.hashsalt': 'thinmap',
    'font.size': 10.0,
    'path.simplify': True,
}


FORMATS: Any = {'png': {'Software': None}, 'svg': {'Date': None}}  # no date and no version


def write_plot(folder: Path, plot: Plot) -> None:
    """Write NAME.png and NAME.svg into a folder."""
    for ending, picture in zip(FORMATS, drawn(plot, FORMATS), strict=True):
        with atomic_write(folder / f'{plot.name}.{ending}') as aside:
            aside.write_bytes(picture)


def drawn(plot: Plot, formats: Iterable[str]) -> list[bytes]:
    """Pictures of a plot in some of the formats."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = -(-len(plot.panels) // plot.columns)
    width, height = plot.panel_inches
    with matplotlib.rc_context(_SETTINGS):
        figure = Figure(figsize=(width * plot.columns, height * rows + 0.3), dpi=DPI)
        figure.set_layout_engine('constrained', h_pad=_PAD, w_pad=_PAD)
        FigureCanvasAgg(figure)
        for axes, panel in zip(
            figure.subplots(rows, plot.columns, squeeze=False).flat, plot.panels, strict=False
        ):
            _draw_panel(axes, panel)
        for axes in figure.axes[len(plot.panels) : rows * plot.columns]:
            axes.set_visible(False)
        _add_legend(figure, plot.legend)
        pictures = []
        for ending in formats:
            picture = BytesIO()
            figure.savefig(picture, format=ending, metadata=FORMATS[ending])
            pictures.append(picture.getvalue())
        return pictures


def _add_legend(figure: 'Figure', where: str) -> None:
    """One legend for all panels below them, or one in each panel."""
    if where == 'inside':
        for axes in figure.axes:
            if axes.get_legend_handles_labels()[0]:
                axes.legend(fontsize=8, framealpha=0.9)
        return
    handles = {}
    for axes in figure.axes:
        handles.update(
            {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
        )
    if handles:
        columns = max(1, min(len(handles), int(figure.get_figwidth() / 1.7)))
        figure.legend(
            handles.values(),
            handles.keys(),
            loc='outside lower center',
            ncols=columns,
            fontsize=8,
            frameon=False,
        )


def _draw_panel(axes: 'Axes', panel: Panel) -> None:
    for layer in panel.layers:
        _draw(layer, axes)
    axes.set_title(panel.title, fontsize=10)
    axes.set(xlabel=panel.x_label, ylabel=panel.y_label)
    if panel.plan:
        axes.set_aspect('equal')
    else:
        axes.grid(alpha=0.3)
    if panel.log_x:
        axes.set_xscale('log')
    if panel.log_y:
        axes.set_yscale('log')
    left, right, bottom, top = panel.limits
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)


def _colour(colour: int | str) -> str:
    return colour if isinstance(colour, str) else palette.PALETTE[colour % len(palette.PALETTE)]


@singledispatch
def _draw(layer: object, axes: 'Axes') -> None:
    raise TypeError(type(layer).__name__)


@_draw.register(Curve)
def _(layer: Curve, axes: 'Axes') -> None:
    axes.plot(
        *layer.points.T,
        color=_colour(layer.colour),
        linestyle=layer.style or 'none',
        marker=layer.marker,
        linewidth=layer.width,
        markersize=layer.size,
        label=layer.label or None,
        rasterized=len(layer.points) > _MANY,
    )


@_draw.register(Band)
def _(layer: Band, axes: 'Axes') -> None:
    label = layer.label or None
    colour = _colour(layer.colour)
    axes.fill_between(
        layer.x, layer.low, layer.high, color=colour, alpha=0.25, linewidth=0.0, label=label
    )


@_draw.register(Bars)
def _(layer: Bars, axes: 'Axes') -> None:
    places = np.arange(len(layer.names))[::-1]
    axes.barh(places, layer.values, color=[_colour(c) for c in layer.colours], height=0.7)
    axes.set_yticks(places, layer.names)
    for place, value in zip(places, layer.values, strict=True):
        axes.text(
            0.0, place, f' {value:.3g}', va='center', fontsize=8, color='white', fontweight='bold'
        )


@_draw.register(Segments)
def _(layer: Segments, axes: 'Axes') -> None:
    from matplotlib.collections import LineCollection

    lines = LineCollection(
        list(layer.ends.reshape(-1, 2, 2)),
        colors=_colour(layer.colour),
        linewidths=layer.width,
        label=layer.label or None,
        zorder=3,
    )
    axes.add_collection(lines)
    axes.autoscale_view()


@_draw.register(TextLabels)
def _(layer: TextLabels, axes: 'Axes') -> None:
    for at, word in zip(layer.at, layer.words, strict=True):
        axes.annotate(
            word,
            at,
            annotation_clip=True,
            xytext=(4, 4),
            textcoords='offset points',
            fontsize=layer.size,
            zorder=8,
            bbox={
                'boxstyle': 'round,pad=0.1',
                'facecolor': 'white',
                'edgecolor': 'none',
                'alpha': 0.75,
            },
        )


@_draw.register(RobotMarkers)
def _(layer: RobotMarkers, axes: 'Axes') -> None:
    from matplotlib.patches import Circle

    for k, (x, y, theta) in enumerate(layer.poses):
        disc = Circle(
            (x, y),
            layer.radius_m,
            facecolor='none',
            edgecolor=palette.ESTIMATE,
            linewidth=2.0,
            zorder=7,
        )
        disc.set_label(layer.label if k == 0 else '')
        axes.add_patch(disc)
        tip = (x + 1.8 * layer.radius_m * np.cos(theta), y + 1.8 * layer.radius_m * np.sin(theta))
        axes.plot([x, tip[0]], [y, tip[1]], color=palette.ESTIMATE, linewidth=2.0, zorder=7)


@_draw.register(MapLayer)
def _(layer: MapLayer, axes: 'Axes') -> None:
    draw_map(axes, layer.patch)


@_draw.register(GraphLayer)
def _(layer: GraphLayer, axes: 'Axes') -> None:
    draw_graph(axes, layer.topology, layer.size)


@_draw.register(Raster)
def _(layer: Raster, axes: 'Axes') -> None:
    frame = layer.frame
    (rows, cols) = layer.values.shape
    right = frame.origin_x + cols * frame.resolution
    top = frame.origin_y + rows * frame.resolution
    low, high = layer.limits or (float(np.nanmin(layer.values)), float(np.nanmax(layer.values)))
    image = axes.imshow(
        layer.values,
        cmap='viridis',
        vmin=low,
        vmax=high,
        origin='lower',
        interpolation='nearest',
        extent=(frame.origin_x, right, frame.origin_y, top),
    )
    figure = axes.get_figure()
    if figure is not None:
        figure.colorbar(image, ax=axes, label=layer.label, shrink=0.8)
