"""Shows core values in rerun, live or in an .rrd file."""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import UNKNOWN, GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap
from thinmap_ros.view import palette
from thinmap_ros.view.interface import NullView
from thinmap_ros.view.palette import rgb
from thinmap_ros.view.rerun_sinks import TIMELINE, RecordingSinks, library

UNKNOWN_GREY = 205
_WIDTHS = (5, 3)  # of the map, and of curves and legends
_PLOT_WIDTHS = (3, 1)  # of curves, and of their legend
_COLOURS = ('blue', 'orange', 'green', 'pink', 'amber', 'light blue', 'grey')  # of the palette

LEGEND = """
- **orange** end node with its position probability, **grey** it will stay;
  **dark blue** branch, **amber** corner, **green** skeleton
- **pink** estimated path, pose and its 95 %; **indigo** true path; **grey** odometry;
  **yellow** planned path and target; **purple** samples
- **red** scan; **brown** scans of a piece of map whose place is unknown;
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


def styles(rr: Any) -> dict[str, Any]:
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


_ODOMETRY = '#777777'
_SCAN = '#CC0000'
_PLAN = '#F0E442'  # and its target
_SAMPLE = '#7B3FA0'
_LOCAL = '#0072B2'  # lines and nodes of the local area
_LINE = '#8FBEDB'
_STAYS = '#7D7D7D'  # an end node with position probability 1
_LABEL = '#000000'
_NO_TEXT: Mapping[str, Any] = {}
# Colour and radius in pixels: the estimated path is visible below the true one.
_TRAILS = {
    'estimate': (palette.ESTIMATE, 2.4),
    'truth': (palette.TRUTH, 0.9),
    'odometry': (_ODOMETRY, 1.2),
}

# Heights above the map, m, in the order of importance.
_Z = {
    'apart': 0.005,
    'regions': 0.01,
    'skeleton': 0.02,
    'lines': 0.03,
    'samples': 0.035,
    'odometry': 0.04,
    'estimate': 0.05,
    'truth': 0.06,
    'plan': 0.07,
    'local_area': 0.075,
    'nodes': 0.08,
    'target': 0.085,
    'end_nodes': 0.09,
    'covariance': 0.11,
    'robot': 0.12,
}


@dataclass(frozen=True)
class _Thresholds:
    """When something is drawn; they limit the size of a recording.

    period_ns: between two values of a large entity. trail_step_m: between two points of a
    trajectory. growth: factor by which the map has grown when the camera moves.
    """

    period_ns: int
    trail_step_m: float
    growth: float


@dataclass(frozen=True)
class _Confidence:
    """Outlines of the 95 % confidence regions of the position and of the heading.

    chi_square: with 2 degrees of freedom. points: of the ellipse. sigmas: half the angle of the
    wedge. wedge_m: its length.
    """

    chi_square: float
    points: int
    sigmas: float
    wedge_m: float


_DRAWN = _Thresholds(period_ns=1_000_000_000, trail_step_m=0.05, growth=1.4)
_CONFIDENCE = _Confidence(chi_square=5.991, points=33, sigmas=1.96, wedge_m=1.0)


class View(NullView):
    """A recording in rerun: to a file, to a viewer that it opens, or to both. Close it.

    Memory is bounded: large entities are logged at most once a second, a scan replaces the previous
    one, a trajectory consists of steps, and the viewer drops the oldest data beyond a limit.
    """

    def __init__(self, recording: Path | None = None, spawn: bool = False) -> None:
        """Begin a recording.

        Raises InputError if rerun is missing, the file cannot be written, or there is no display
        for the viewer.
        """
        self._rr = library()
        self._streams = RecordingSinks()
        self._drawn_ns: dict[str, int] = {}
        self._waiting: dict[str, tuple[int, Callable[[], None]]] = {}
        self._trail_ends: dict[str, Array] = {}
        self._lasers: dict[str, str] = {}  # paths, by frame
        self._target = np.zeros((0, 2))
        self._patch: GridPatch | None = None
        self._framed_m = 0.0
        self._curves: dict[str, dict[str, None]] = {}
        self._zeros: dict[tuple[str, str], int] = {}
        if spawn:
            self._streams.open_viewer()
        if recording is not None:
            self._streams.open_file(recording)
        self._log_static()

    def grid(self, ns: int, patch: GridPatch) -> None:
        """Show the map, at most once a second.

        The camera moves back when the map has outgrown the view.
        """

        def draw() -> None:
            rr = self._rr
            frame = patch.frame
            rows, cols = patch.shape
            form = rr.components.ImageFormat(
                width=cols, height=rows, color_model='L', channel_datatype='U8'
            )
            origin = [frame.origin_x, frame.origin_y, 0.0]
            # The first row of an image is the top.
            data = np.ascontiguousarray(_shade(patch)[::-1]).tobytes()
            # Otherwise grey values are shown with a colour map.
            grey = rr.components.Colormap.Grayscale
            size = frame.resolution
            image = rr.GridMap(
                data=data, format=form, cell_size=size, translation=origin, colormap=grey
            )
            self._log('map/grid', image)

        self._patch = patch
        self._throttled('grid', ns, draw)
        if size_m(patch) > _DRAWN.growth * self._framed_m:
            self._frame(patch)

    def scan(self, ns: int, scan: Scan) -> None:
        """Show a scan at the pose of the robot; it replaces the previous scan of its laser."""
        self._at(ns)
        points = self._rr.Points3D(
            _lifted(scan.points_base(), 0.0), colors=[rgb(_SCAN)], radii=[self._px(1.8)]
        )
        # The path of the first laser is that of the only one.
        path = self._lasers.setdefault(
            scan.frame, f'map/robot/scan/{len(self._lasers)}' if self._lasers else 'map/robot/scan'
        )
        self._log(path, points)

    def pose(self, ns: int, T_map_base: Array, covariance: Array) -> None:
        """Show the robot pose with its covariance (3, 3) over x, y, theta.

        The poses form the trajectory `estimate`.
        """
        rr = self._rr
        self._at(ns)
        x, y, theta = (float(v) for v in T_map_base)
        turn = rr.RotationAxisAngle(axis=[0.0, 0.0, 1.0], radians=theta)
        self._log('map/robot', rr.Transform3D(translation=[x, y, _Z['robot']], rotation=turn))
        outline = [
            _ellipse(T_map_base[:2], covariance[:2, :2]),
            _wedge(T_map_base, float(covariance[2, 2])),
        ]
        strips = [_lifted(points, _Z['covariance']) for points in outline]
        self._log(
            'map/covariance',
            rr.LineStrips3D(strips, colors=[rgb(palette.ESTIMATE)], radii=[self._px(1.0)]),
        )
        self.trajectory(ns, 'estimate', T_map_base)

    def trajectory(self, ns: int, name: str, T_map_base: Array) -> None:
        """Extend a trajectory: `estimate`, `truth` or `odometry`."""
        here = np.array(T_map_base[:2])
        before = self._trail_ends.setdefault(name, here)
        if np.hypot(*(here - before)) < _DRAWN.trail_step_m:
            return
        self._trail_ends[name] = here
        self._at(ns)
        step = _lifted(np.array([before, here]), _Z[name])
        colour, radius_px = _TRAILS[name]
        self._log(
            f'map/{name}',
            self._rr.LineStrips3D([step], colors=[rgb(colour)], radii=[self._px(radius_px)]),
        )

    def topology(self, ns: int, topology: TopologicalMap) -> None:
        """Show the skeleton, and the nodes coloured by kind, at most once a second."""
        paths = [edge.path for edge in topology.edges.values()]
        self._lines(ns, 'skeleton', paths, [palette.EDGE], [1.2])
        nodes = list(topology.nodes.values())
        places = np.array([node.position for node in nodes]).reshape(-1, 2)
        self._points(ns, 'nodes', places, [rgb(palette.NODES[node.kind]) for node in nodes], 4.0)

    def regions(self, ns: int, outlines: Sequence[Array], colours: Sequence[str]) -> None:
        """Show the outlines (K, 2) of regions in their colours, at most once a second."""
        closed = [np.concatenate([outline, outline[:1]]) for outline in outlines]
        self._lines(ns, 'regions', closed, colours, [3.0])

    def apart(self, ns: int, points: Array) -> None:
        """Show the scan points (N, 2) of pieces whose place is unknown, at most once a second."""
        self._points(ns, 'apart', points, [rgb(palette.APART)], 1.2)

    def end_nodes(self, ns: int, places: Array, probabilities: Array) -> None:
        """Show end nodes (N, 2) with their position probabilities (N,), at most once a second."""
        shades = [_faded(palette.NODES[NodeKind.END], float(p)) for p in probabilities]
        self._points(ns, 'end_nodes', places, shades, 6.0)
        # Text has the colour of its point: grey cannot be read.
        text = {'labels': [f'{p:.2f}' for p in probabilities], 'show_labels': True}
        self._points(ns, 'end_nodes/probability', places, [rgb(_LABEL)], 0.0, text)

    def lines(self, ns: int, segments: Array, local: NDArray[np.bool_]) -> None:
        """Show line features by their ends (N, 2, 2), at most once a second.

        local (N,): which are in the local area.
        """
        shades = [_LOCAL if near else _LINE for near in local]
        self._lines(ns, 'lines', segments, shades, [2.5 if near else 1.5 for near in local])

    def local_area(self, ns: int, places: Array) -> None:
        """Show the nodes (N, 2) of the local area, at most once a second."""
        self._points(ns, 'local_area', places, [[*rgb(_LOCAL), 90]], 9.0)

    def particles(self, ns: int, places: Array) -> None:
        """Show the particles (N, 2) of global localization, at most once a second."""
        self._points(ns, 'samples', places, [rgb(_SAMPLE)], 1.2)

    def plan(self, ns: int, points: Array) -> None:
        """Show the path (N, 2) that the robot follows, at most once a second."""
        self._lines(ns, 'plan', [points] if len(points) > 1 else [], [_PLAN], [2.0])

    def _points(
        self,
        ns: int,
        layer: str,
        points: Array,
        colours: Sequence[list[int]],
        radius_px: float,
        text: Mapping[str, Any] = _NO_TEXT,
    ) -> None:
        """Show points (N, 2) at the height of their layer, at most once a second."""
        lifted = _lifted(points, _Z[layer.partition('/')[0]])

        def draw() -> None:
            radii = [self._px(radius_px)]
            shown = self._rr.Points3D(lifted, colors=colours, radii=radii, **text)
            self._log(f'map/{layer}', shown)

        self._throttled(layer, ns, draw)

    def _lines(
        self,
        ns: int,
        layer: str,
        lines: Iterable[Array],
        colours: Sequence[str],
        radii_px: Sequence[float],
    ) -> None:
        """Show lines, each (K, 2), at the height of their layer, at most once a second."""
        lifted = [_lifted(line, _Z[layer]) for line in lines]

        def draw() -> None:
            radii = [self._px(radius) for radius in radii_px]
            shades = [rgb(colour) for colour in colours]
            self._log(f'map/{layer}', self._rr.LineStrips3D(lifted, colors=shades, radii=radii))

        self._throttled(layer, ns, draw)

    def target(self, ns: int, place: Array | None) -> None:
        """Show the target (2,) of the robot, or remove it."""
        places = np.zeros((0, 2)) if place is None else place.reshape(1, 2)
        if np.array_equal(places, self._target):
            return
        self._target = places
        self._at(ns)
        points = self._rr.Points3D(
            _lifted(places, _Z['target']), colors=[rgb(_PLAN)], radii=[self._px(10.0)]
        )
        self._log('map/target', points)

    def scalar(self, ns: int, plot: str, curve: str, value: float) -> None:
        """Add a value to a curve of a plot (`error`, `progress`, `count`, `step`).

        A curve that has only been zero is not shown.
        """
        is_new = curve not in self._curves.get(plot, {})
        if is_new and value == 0.0:
            self._zeros.setdefault((plot, curve), ns)
            return
        if is_new:
            self._begin_curve(plot, curve)
        self._log_value(ns, plot, curve, value)

    def _begin_curve(self, plot: str, curve: str) -> None:
        """Name a curve in the legend of its plot, and show its first value if that was zero."""
        known = self._curves.setdefault(plot, {})
        known[curve] = None
        text = self._rr.TextDocument(curve_legend(plot, known), media_type='text/markdown')
        self._log(legend_entity(plot), text, static=True)
        first_ns = self._zeros.pop((plot, curve), None)
        if first_ns is not None:
            self._log_value(first_ns, plot, curve, 0.0)

    def _log_value(self, ns: int, plot: str, curve: str, value: float) -> None:
        self._at(ns)
        self._log(entity(plot, curve), self._rr.Scalars([value]))

    def wait_until_closed(self) -> None:
        """Show all pending data, and wait until the viewer is closed."""
        self._finish_drawing()
        if self._streams.viewer is not None:
            self._streams.viewer.wait()

    def close(self) -> None:
        """Log all pending data, finish the file, and end the viewer.

        The file then opens with the whole map in view.
        Raises InputError if the file could not be completed.
        """
        self._finish_drawing()
        self._streams.close()

    def _finish_drawing(self) -> None:
        for name in list(self._waiting):
            self._draw(name)
        if self._patch is not None:
            self._frame(self._patch)

    def _log_static(self) -> None:
        rr = self._rr
        self._log('map', rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        arrow = rr.Arrows3D(vectors=[[0.45, 0.0, 0.0]], colors=[[0, 0, 0]], radii=[self._px(2.5)])
        self._log('map/robot/heading', arrow, static=True)
        body = rr.Points3D([[0.0, 0.0, 0.0]], colors=[[0, 0, 0]], radii=[self._px(6.0)])
        self._log('map/robot/body', body, static=True)
        self._log(
            'legend',
            rr.TextDocument(LEGEND, media_type='text/markdown'),
            static=True,
        )
        for entity, style in styles(rr).items():
            self._log(entity, style, static=True)

    def _frame(self, patch: GridPatch) -> None:
        """Move the camera so that the whole map is in view."""
        self._framed_m = size_m(patch)
        self._streams.send_blueprint(
            blueprint(self._rr, patch, [f'map/{name}' for name in _TRAILS])
        )

    def _px(self, pixels: float) -> Any:
        """A radius in pixels, visible at any map size."""
        return self._rr.Radius.ui_points(pixels)

    def _throttled(self, name: str, ns: int, draw: Callable[[], None]) -> None:
        """Draw at most once a period; otherwise the newest value waits."""
        self._waiting[name] = (ns, draw)
        drawn = self._drawn_ns.get(name)
        if drawn is None or abs(ns - drawn) >= _DRAWN.period_ns:
            self._draw(name)

    def _draw(self, name: str) -> None:
        ns, draw = self._waiting.pop(name)
        self._drawn_ns[name] = ns
        self._at(ns)
        draw()

    def _at(self, ns: int) -> None:
        self._streams.at(ns)

    def _log(self, entity: str, value: Any, static: bool = False) -> None:
        self._streams.log(entity, value, static)


def _shade(patch: GridPatch) -> NDArray[np.uint8]:
    """Grey value of each cell (H, W): lighter if more likely free."""
    grey = np.round(2.55 * (100.0 - np.clip(patch.cells, 0, 100)))
    return np.where(patch.cells == UNKNOWN, UNKNOWN_GREY, grey).astype(np.uint8)


def _faded(colour: str, share: float) -> list[int]:
    """A colour, mixed with grey by a share, 0 to 1."""
    return [
        round((1.0 - share) * c + share * grey)
        for c, grey in zip(rgb(colour), rgb(_STAYS), strict=True)
    ]


def _lifted(points: Array, z: float) -> NDArray[np.float32]:
    """Points (N, 2) at a height, (N, 3)."""
    return np.column_stack([points, np.full(len(points), z)]).astype(np.float32)


def _ellipse(centre: Array, covariance: Array) -> Array:
    """Outline (N, 2) of the 95 % confidence ellipse of a covariance (2, 2)."""
    values, vectors = np.linalg.eigh(covariance)
    angles = np.linspace(0.0, 2.0 * np.pi, _CONFIDENCE.points)
    axes = vectors * np.sqrt(_CONFIDENCE.chi_square * np.maximum(values, 0.0))
    return np.asarray(centre + np.column_stack([np.cos(angles), np.sin(angles)]) @ axes.T)


def _wedge(T_map_base: Array, variance: float) -> Array:
    """Outline (3, 2) of the 95 % confidence wedge of the heading, given its variance."""
    x, y, theta = T_map_base.tolist()
    spread = min(_CONFIDENCE.sigmas * np.sqrt(max(variance, 0.0)), np.pi)
    ends = [
        (x + _CONFIDENCE.wedge_m * np.cos(theta + s), y + _CONFIDENCE.wedge_m * np.sin(theta + s))
        for s in (-spread, spread)
    ]
    return np.array([ends[0], (x, y), ends[1]])
