"""Contents of figures as plain data: panels of layers. `plot_writer` draws them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap


@dataclass(frozen=True, eq=False)
class Curve:
    """A line through points (N, 2), or only markers if the style is empty.

    Colour: index in the palette.
    """

    points: Array
    label: str = ''
    colour: int | str = 0
    style: str = '-'
    marker: str = ''
    width: float = 1.5
    size: float = 5.0


@dataclass(frozen=True, eq=False)
class Band:
    """The space between low and high (N,) over x (N,)."""

    x: Array
    low: Array
    high: Array
    label: str = ''
    colour: int | str = 0


@dataclass(frozen=True, eq=False)
class Bars:
    """A bar for each name, labelled with its value (N,)."""

    names: Sequence[str]
    values: Array
    colours: Sequence[int]


@dataclass(frozen=True, eq=False)
class Segments:
    """Straight lines (N, 4): x and y of one end, x and y of the other."""

    ends: Array
    label: str = ''
    colour: int | str = 'black'
    width: float = 1.5


@dataclass(frozen=True, eq=False)
class TextLabels:
    """A label at each of some points (N, 2)."""

    at: Array
    words: Sequence[str]
    size: float = 8.0


@dataclass(frozen=True, eq=False)
class RobotMarkers:
    """A disc with a heading for each pose (N, 3)."""

    poses: Array
    label: str = 'robot'
    radius_m: float = 0.22


@dataclass(frozen=True, eq=False)
class MapLayer:
    """A grid: free white, occupied black, unknown grey."""

    patch: GridPatch


@dataclass(frozen=True, eq=False)
class GraphLayer:
    """A topological map.

    The paths of its edges, and its nodes with a shape and a colour for each kind.
    """

    topology: TopologicalMap
    size: float = 5.0


@dataclass(frozen=True, eq=False)
class Raster:
    """Values (H, W) on the cells of a frame, NaN: none, with a scale of colours beside it."""

    values: Array
    frame: GridFrame
    label: str
    limits: tuple[float, float] | None = None


Layer = Curve | Band | Bars | Segments | TextLabels | RobotMarkers | MapLayer | GraphLayer | Raster


@dataclass(frozen=True, eq=False)
class Panel:
    """Layers over one pair of axes; plan: x and y are metres of the same length.

    limits: (x, x, y, y).
    """

    layers: Sequence[Layer]
    title: str = ''
    x_label: str = 'x (m)'
    y_label: str = 'y (m)'
    plan: bool = True
    log_x: bool = False
    log_y: bool = False
    limits: tuple[float | None, float | None, float | None, float | None] = (None, None, None, None)


@dataclass(frozen=True, eq=False)
class Plot:
    """A figure: the name of its files, what it shows, and its panels, row by row.

    panel_inches: width and height.
    """

    name: str
    caption: str
    panels: Sequence[Panel]
    columns: int = 1
    panel_inches: tuple[float, float] = (5.0, 4.0)
    legend: str = field(default='below')


def xy(x: Array, y: Array) -> Array:
    """Points (N, 2) of x (N,) and y (N,)."""
    return np.column_stack([x, y])


_PANEL_INCHES = (4.6, 2.6)
_FROM_ZERO = (0.0, None, 0.0, None)


def error_plot(trajectories: Mapping[str, Mapping[str, Array]]) -> Plot:
    """Errors over time, a panel for each of them and a curve for each trajectory.

    trajectories: by name, their errors by name and unit, (N, 2): stamp, s, and error.
    """
    curves = list(trajectories.values())
    began_s = min(curve[0, 0] for errors in curves for curve in errors.values())
    panels = []
    for error in curves[0]:
        of, unit = error.split(', ')
        lines = (
            Curve(errors[error] - (began_s, 0.0), name, k, width=1.0)
            for k, (name, errors) in enumerate(trajectories.items())
        )
        panels.append(_panel(of, 'time (s)', unit, lines))
    return Plot('errors', '', panels, columns=2, panel_inches=_PANEL_INCHES)


def run_plot(report: Mapping[str, Any]) -> Plot | None:
    """Coverage over the path, or over time, and position error over time, of a report.

    None if the report has neither.
    """
    panels = []
    if 'curve' in report:
        *axis, share = np.array(report['curve']).T
        along = Curve(xy(axis[-1], 100.0 * share))
        panels.append(
            _panel('Area seen', 'path (m)' if len(axis) > 1 else 'time (s)', '%', [along])
        )
    error = np.array(report.get('error_curve', np.empty((0, 2))))
    if error[:, 1].any():  # with the true pose there is none
        panels.append(_panel('Position error', 'time (s)', 'm', [Curve(error, colour=1)]))
    return Plot('curves', '', panels, len(panels), _PANEL_INCHES) if panels else None


def _panel(title: str, x_label: str, y_label: str, curves: Iterable[Curve]) -> Panel:
    return Panel(list(curves), title, x_label, y_label, plan=False, limits=_FROM_ZERO)
