"""Layout of a view in rerun: the map, curves beside it, and a legend below them."""

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.view import palette
from thinmap_ros.view.rerun_sinks import TIMELINE

UNKNOWN_GREY = 205
_WIDTHS = (5, 3)  # of the map, and of curves and legends
_PLOT_WIDTHS = (3, 1)  # of curves, and of their legend
_COLOURS = ('blue', 'orange', 'green', 'pink', 'amber', 'light blue', 'grey')  # of the palette
LEGEND = """
- **orange** end node with its position probability, **grey** it will stay;
  **dark blue** branch, **amber** corner, **green** skeleton
- **pink** estimated path, pose and its 95 %; **indigo** true path; **grey** odometry;
  **yellow** planned path and target; **purple** samples
- **red** scan; **pale pink** scans of a piece of map whose place is unknown;
  **blue** features of the local area, its nodes ringed; **pale blue** other features
- **pale outlines** on the walls: rooms (blue), corridors (sand), halls (green)
"""
# Each curve: name in the legend and colour, by plot.
_PLOTS = {
    'error': ('pose: error, 2 sigma', ('position, cm', 'heading, deg', '2 sigma, cm')),
    'progress': ('progress', ('seen, m2', 'distance, m')),
    'count': ('counts', ('features', 'local features', 'matched lines', 'nodes', 'end nodes left')),
    'step': (
        'step times, ms',
        ('localizer', 'map update', 'graph update', 'explorer', 'global localization'),
    ),
}


@dataclass(frozen=True)
class _Camera:
    """The camera above the map, which looks straight down: all parts of the map have one scale.

    aspect: width over height of the map's part of the window, or less. half_view_rad: half of the
    vertical field of view of rerun's camera. margin: size of the picture over that of the map.
    """

    aspect: float
    half_view_rad: float
    margin: float


_CAMERA = _Camera(aspect=1.3, half_view_rad=math.radians(27.5), margin=1.1)


def entity(plot: str, curve: str) -> str:
    """Entity path of a curve."""
    return f'plots/{plot}/{curve.replace(",", "").replace("%", "percent").replace(" ", "_")}'


def style(rr: Any) -> dict[str, Any]:
    """Names and colours of all curves, by entity."""
    return {
        entity(plot, curve): rr.SeriesLines(
            colors=[palette.rgb(colour)], names=[curve], widths=[1.5]
        )
        for plot, (_, curves) in _PLOTS.items()
        for curve, colour in zip(curves, palette.PALETTE, strict=False)
    }


def curve_legend(plot: str, curves: Collection[str]) -> str:
    """Legend of the curves that a plot has so far."""
    known = zip(_PLOTS[plot][1], _COLOURS, strict=False)
    return '\n'.join(f'- **{colour}** {curve}' for curve, colour in known if curve in curves)


def legend_entity(plot: str) -> str:
    """Entity path of the legend of a plot."""
    return f'legends/{plot}'


def blueprint(rr: Any, patch: GridPatch, trails: list[str]) -> Any:
    """Layout in which the whole map is in view; trajectories (entities) are shown in full."""
    rrb = rr.blueprint
    past = {
        'start': rrb.TimeRangeBoundary.infinite(),
        'end': rrb.TimeRangeBoundary.cursor_relative(),
    }
    scene = rrb.Spatial3DView(
        origin='map',
        name='map',
        eye_controls=_eye(rrb, patch),
        background=rrb.Background(color=[UNKNOWN_GREY] * 3),
        line_grid=rrb.LineGrid3D(visible=False),
        overrides={name: rrb.VisibleTimeRanges(timeline=TIMELINE, **past) for name in trails},
    )
    # rerun's own legend covers the curves.
    inside = rrb.PlotLegend(visible=False)
    everything = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite()
    )
    axis = rrb.TimeAxis(view_range=everything)
    curves = [
        rrb.Horizontal(
            rrb.TimeSeriesView(origin=f'plots/{plot}', name=name, plot_legend=inside, axis_x=axis),
            rrb.TextDocumentView(origin=legend_entity(plot), name='curves'),
            column_shares=_PLOT_WIDTHS,
        )
        for plot, (name, _) in _PLOTS.items()
    ]
    legend = rrb.TextDocumentView(origin='legend', name='colours')
    beside = rrb.Vertical(*curves, legend)
    layout = rrb.Horizontal(scene, beside, column_shares=_WIDTHS)
    # At the newest time: a live view follows, and a file opens at its end.
    time = rrb.TimePanel(state='collapsed', play_state='following')
    panels = rrb.BlueprintPanel(state='hidden'), rrb.SelectionPanel(state='hidden'), time
    return rrb.Blueprint(layout, *panels)


def size_m(patch: GridPatch) -> float:
    """Size of a map that determines the distance of the camera."""
    rows, cols = patch.shape
    return patch.frame.resolution * max(rows, cols / _CAMERA.aspect)


def _eye(rrb: Any, patch: GridPatch) -> Any:
    """Camera at the zenith of the map's centre; y points up in the picture."""
    rows, cols = patch.shape
    frame = patch.frame
    x = frame.origin_x + frame.resolution * cols / 2.0
    y = frame.origin_y + frame.resolution * rows / 2.0
    height = _CAMERA.margin * size_m(patch) / (2.0 * math.tan(_CAMERA.half_view_rad))
    return rrb.EyeControls3D(
        position=(x, y, height), look_target=(x, y, 0.0), eye_up=(0.0, 1.0, 0.0)
    )
