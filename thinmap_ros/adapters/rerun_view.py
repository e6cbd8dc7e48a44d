"""Core values shown in rerun, live or in an .rrd file. rerun is optional: it is the extra `viewer`."""

import contextlib
import importlib.util
import os
import socket
import subprocess
import sys
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.adapters import colours
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import UNKNOWN, GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap

_APPLICATION, _TIMELINE = 'thinmap', 'time'
# What is large is drawn at most so often, and a trail grows by steps of so much: a recording grows slowly.
_PERIOD_NS = 1_000_000_000
_TRAIL_STEP_M = 0.05
_MEMORY_LIMIT, _SERVER_MEMORY_LIMIT = '1GB', '256MB'
_LOCALHOST = '127.0.0.1'
_FLUSH_S = 0.8
_OUTLINE, _UNKNOWN_GREY = 33, 205
_SIGMA2_95 = 5.991  # chi-square, 95 %, 2 degrees of freedom
_ODOMETRY, _SCAN, _LINE, _PLAN, _TARGET = '#999999', '#D55E00', '#0072B2', '#F0E442', '#F0E442'
_TRAILS = {'estimate': colours.ESTIMATE, 'truth': colours.TRUTH, 'odometry': _ODOMETRY}
# Heights above the map, so that what matters more covers what matters less, m.
_Z = {
    'skeleton': 0.02, 'lines': 0.03, 'odometry': 0.04, 'truth': 0.05, 'estimate': 0.06, 'plan': 0.07, 'nodes': 0.08,
    'end_nodes': 0.09, 'target': 0.1, 'covariance': 0.11, 'robot': 0.12,
}
_PLOTS = {'coverage': 'coverage', 'distance_m': 'distance, m', 'error': 'pose error', 'step_ms': 'step time, ms'}


def is_installed() -> bool:
    """Whether the extra `viewer` is there."""
    return importlib.util.find_spec('rerun') is not None


class NullView:
    """What a view is told, shown to nobody.

    Each call gives the stamp in ns; poses (3,) and points are in the map frame, m and rad.
    """

    def grid(self, ns: int, patch: GridPatch) -> None:
        """Show the map."""

    def scan(self, ns: int, scan: Scan) -> None:
        """Show a scan where the robot is; it replaces the one before."""

    def pose(self, ns: int, T_map_base: Array, covariance: Array) -> None:
        """Show the robot with its covariance (3, 3) over x, y, theta; its way becomes the trail `estimate`."""

    def trail(self, ns: int, name: str, T_map_base: Array) -> None:
        """Lengthen the trail of this name: `estimate`, `truth` or `odometry`."""

    def topology(self, ns: int, topology: TopologicalMap) -> None:
        """Show the skeleton, and the nodes coloured by kind."""

    def end_nodes(self, ns: int, places: Array, probabilities: Array) -> None:
        """Show end nodes at places (N, 2) with their position probabilities (N,), 0 to 1."""

    def lines(self, ns: int, segments: Array) -> None:
        """Show line features by their ends (N, 2, 2)."""

    def plan(self, ns: int, points: Array) -> None:
        """Show the path (N, 2) that the robot follows."""

    def target(self, ns: int, place: Array | None) -> None:
        """Show where the robot is going, (2,), or that it has no target."""

    def number(self, ns: int, name: str, value: float) -> None:
        """Continue the curve `plot/name`."""

    def close(self) -> None:
        """Finish what is shown or written."""


class View(NullView):
    """A recording in rerun: to a file, to a viewer that it opens, or to both. Close it.

    Memory is bounded: what is large is logged at most once a second, a scan replaces the one before, a trail is made of
    steps, and the viewer has a limit beyond which it forgets the oldest.
    """

    def __init__(self, recording: Path | None = None, spawn: bool = False) -> None:
        """Begin a recording.

        Raises InputError where rerun is missing, the file cannot be written, or there is no screen for the viewer.
        """
        self._rr = _rerun()
        self._recording = recording
        self._viewer: subprocess.Popen[bytes] | None = None
        # A stream of its own for each: a viewer that hangs must not keep the file from being finished.
        self._files: list[Any] = []
        self._shown: list[Any] = []
        self._first_ns: int | None = None
        self._drawn_ns: dict[str, int] = {}
        self._waiting: dict[str, tuple[int, Callable[[], None]]] = {}
        self._trail_ends: dict[str, Array] = {}
        self._target = np.zeros((0, 2))
        self._patch: GridPatch | None = None
        self._framed = False
        if spawn:
            self._open_viewer()
        if recording is not None:
            self._open_file(recording)
        self._log_static()

    def grid(self, ns: int, patch: GridPatch) -> None:
        """Show the map, at most once a second."""

        def draw() -> None:
            rr, frame = self._rr, patch.frame
            rows, cols = patch.shape
            form = rr.components.ImageFormat(width=cols, height=rows, color_model='L', channel_datatype='U8')
            origin = [frame.origin_x, frame.origin_y, 0.0]
            # An image's first row is its upper one.
            data = np.ascontiguousarray(_shade(patch)[::-1]).tobytes()
            resolution = frame.resolution
            self._log('map/grid', rr.GridMap(data=data, format=form, cell_size=resolution, translation=origin))

        self._patch = patch
        self._now_and_then('grid', ns, draw)
        if not self._framed:
            self._send_blueprint()
            self._framed = True

    def scan(self, ns: int, scan: Scan) -> None:
        """Show a scan where the robot is; it replaces the one before."""
        self._at(ns)
        points = self._rr.Points3D(_lifted(scan.points_base(), 0.0), colors=[_rgb(_SCAN)], radii=[0.03])
        self._log('map/robot/scan', points)

    def pose(self, ns: int, T_map_base: Array, covariance: Array) -> None:
        """Show the robot with its covariance (3, 3) over x, y, theta; its way becomes the trail `estimate`."""
        rr = self._rr
        self._at(ns)
        x, y, theta = (float(v) for v in T_map_base)
        turn = rr.RotationAxisAngle(axis=[0.0, 0.0, 1.0], radians=theta)
        self._log('map/robot', rr.Transform3D(translation=[x, y, _Z['robot']], rotation=turn))
        outline = _lifted(_ellipse(T_map_base[:2], covariance[:2, :2]), _Z['covariance'])
        self._log('map/covariance', rr.LineStrips3D([outline], colors=[_rgb(colours.ESTIMATE)], radii=[0.01]))
        self.trail(ns, 'estimate', T_map_base)

    def trail(self, ns: int, name: str, T_map_base: Array) -> None:
        """Lengthen the trail of this name: `estimate`, `truth` or `odometry`."""
        here = np.array(T_map_base[:2])
        before = self._trail_ends.setdefault(name, here)
        if np.hypot(*(here - before)) < _TRAIL_STEP_M:
            return
        self._trail_ends[name] = here
        self._at(ns)
        step = _lifted(np.array([before, here]), _Z[name])
        self._log(f'map/{name}', self._rr.LineStrips3D([step], colors=[_rgb(_TRAILS[name])], radii=[0.02]))

    def topology(self, ns: int, topology: TopologicalMap) -> None:
        """Show the skeleton, and the nodes coloured by kind, at most once a second."""
        paths = [_lifted(edge.path, _Z['skeleton']) for edge in topology.edges.values()]
        nodes = list(topology.nodes.values())
        places = _lifted(np.array([node.position for node in nodes]).reshape(-1, 2), _Z['nodes'])
        shades = [_rgb(colours.NODES[node.kind]) for node in nodes]

        def draw() -> None:
            strips = self._rr.LineStrips3D(paths, colors=[_rgb(colours.EDGE)], radii=[0.015])
            self._log('map/skeleton', strips)
            self._log('map/nodes', self._rr.Points3D(places, colors=shades, radii=[0.06]))

        self._now_and_then('topology', ns, draw)

    def end_nodes(self, ns: int, places: Array, probabilities: Array) -> None:
        """Show end nodes at places (N, 2) with their position probabilities (N,), at most once a second."""
        labels = [f'{p:.2f}' for p in probabilities]

        def draw() -> None:
            points = self._rr.Points3D(
                _lifted(places, _Z['end_nodes']),
                colors=[_rgb(colours.NODES[NodeKind.END])],
                radii=[0.1],
                labels=labels,
                show_labels=True,
            )
            self._log('map/end_nodes', points)

        self._now_and_then('end_nodes', ns, draw)

    def lines(self, ns: int, segments: Array) -> None:
        """Show line features by their ends (N, 2, 2), at most once a second."""

        def draw() -> None:
            strips = [_lifted(ends, _Z['lines']) for ends in segments]
            self._log('map/lines', self._rr.LineStrips3D(strips, colors=[_rgb(_LINE)], radii=[0.03]))

        self._now_and_then('lines', ns, draw)

    def plan(self, ns: int, points: Array) -> None:
        """Show the path (N, 2) that the robot follows, at most once a second."""

        def draw() -> None:
            strips = [_lifted(points, _Z['plan'])] if len(points) > 1 else []
            self._log('map/plan', self._rr.LineStrips3D(strips, colors=[_rgb(_PLAN)], radii=[0.025]))

        self._now_and_then('plan', ns, draw)

    def target(self, ns: int, place: Array | None) -> None:
        """Show where the robot is going, (2,), or that it has no target."""
        places = np.zeros((0, 2)) if place is None else place.reshape(1, 2)
        if np.array_equal(places, self._target):
            return
        self._target = places
        self._at(ns)
        points = self._rr.Points3D(_lifted(places, _Z['target']), colors=[_rgb(_TARGET)], radii=[0.18])
        self._log('map/target', points)

    def number(self, ns: int, name: str, value: float) -> None:
        """Continue the curve `plot/name`, the plots being `coverage`, `distance_m`, `error` and `step_ms`."""
        self._at(ns)
        self._log(f'plots/{name}', self._rr.Scalars([value]))

    def close(self) -> None:
        """Draw what still waits, finish the file, which then opens with the whole map in view, and end the viewer.

        Raises InputError where the file could not be written to its end.
        """
        for name in list(self._waiting):
            self._draw(name)
        if self._patch is not None:
            self._send_blueprint()
        try:
            for file in self._files:
                _finish(file)
        except RuntimeError as error:
            raise InputError(f'{self._recording}: rerun: {" ".join(str(error).split())}') from error
        finally:
            # After the file: a viewer that was closed makes its stream wait for it.
            for shown in self._shown:
                with contextlib.suppress(RuntimeError):
                    _finish(shown)
            if self._viewer is not None:
                self._viewer.terminate()
                self._viewer.wait()

    def _new_stream(self, sink: Any) -> Any:
        stream = self._rr.RecordingStream(_APPLICATION, recording_id=uuid.uuid4())
        # A recording says when things were, not when they were drawn.
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.set_sinks(sink)
        return stream

    def _open_file(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._files.append(self._new_stream(self._rr.FileSink(str(path))))
        except (OSError, RuntimeError) as error:
            raise InputError(f'{path}: rerun: {" ".join(str(error).split())}') from error

    def _open_viewer(self) -> None:
        """Start a viewer of our own, which listens to this machine only and ends with us."""
        if sys.platform == 'linux' and not (os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY')):
            raise InputError('no screen for the viewer: neither DISPLAY nor WAYLAND_DISPLAY is set')
        port = _free_port()
        command = [_viewer_program(), '--bind', _LOCALHOST, '--port', str(port), '--memory-limit', _MEMORY_LIMIT]
        command += ['--server-memory-limit', _SERVER_MEMORY_LIMIT, '--hide-welcome-screen', '--expect-data-soon']
        try:
            self._viewer = subprocess.Popen(command, stdin=subprocess.DEVNULL)
        except OSError as error:
            raise InputError(f'{command[0]}: {error.strerror or error}: expected the viewer of rerun') from error
        self._shown.append(self._new_stream(self._rr.GrpcSink(f'rerun+http://{_LOCALHOST}:{port}/proxy')))

    def _log_static(self) -> None:
        rr = self._rr
        self._log('map', rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        body = rr.Arrows3D(vectors=[[0.45, 0.0, 0.0]], colors=[[0, 0, 0]], radii=[0.04])
        self._log('map/robot/heading', body, static=True)

    def _send_blueprint(self) -> None:
        """Map large, curves beside it; the eye a little south of straight above, high enough to see the whole map."""
        assert self._patch is not None
        rrb, frame = self._rr.blueprint, self._patch.frame
        rows, cols = self._patch.shape
        size = frame.resolution * max(rows, cols)
        x, y = frame.origin_x + frame.resolution * cols / 2.0, frame.origin_y + frame.resolution * rows / 2.0
        eye = rrb.EyeControls3D(position=(x, y - 0.3 * size, 1.1 * size), look_target=(x, y, 0.0))
        past = {'start': rrb.TimeRangeBoundary.infinite(), 'end': rrb.TimeRangeBoundary.cursor_relative()}
        trails = {f'map/{name}': rrb.VisibleTimeRanges(timeline=_TIMELINE, **past) for name in _TRAILS}
        scene = rrb.Spatial3DView(origin='map', name='map', eye_controls=eye, overrides=trails)
        curves = [rrb.TimeSeriesView(origin=f'plots/{plot}', name=name) for plot, name in _PLOTS.items()]
        layout = rrb.Horizontal(scene, rrb.Vertical(*curves), column_shares=[3, 1])
        for stream in (*self._files, *self._shown):
            stream.send_blueprint(rrb.Blueprint(layout, collapse_panels=True))

    def _now_and_then(self, name: str, ns: int, draw: Callable[[], None]) -> None:
        """Draw now, or, where this was drawn a moment ago, let the newest wait for its turn."""
        self._waiting[name] = (ns, draw)
        drawn = self._drawn_ns.get(name)
        if drawn is None or abs(ns - drawn) >= _PERIOD_NS:
            self._draw(name)

    def _draw(self, name: str) -> None:
        ns, draw = self._waiting.pop(name)
        self._drawn_ns[name] = ns
        self._at(ns)
        draw()

    def _at(self, ns: int) -> None:
        if self._first_ns is None:
            self._first_ns = ns
        for stream in (*self._files, *self._shown):
            stream.set_time(_TIMELINE, duration=np.timedelta64(ns - self._first_ns, 'ns'))

    def _log(self, entity: str, value: Any, static: bool = False) -> None:
        for stream in (*self._files, *self._shown):
            stream.log(entity, value, static=static)


def _rerun() -> Any:
    try:
        import rerun
        import rerun.blueprint
    except ImportError as error:
        raise InputError('rerun is not installed: pip install "thinmap_ros[viewer]"') from error
    return rerun


def _viewer_program() -> str:
    """The viewer that came with the library, which need not be on the PATH."""
    spec = importlib.util.find_spec('rerun_cli')
    program = Path(spec.origin).with_name('rerun') if spec is not None and spec.origin else None
    return str(program) if program is not None and program.exists() else 'rerun'


def _free_port() -> int:
    """A port of its own for each viewer: two runs at once do not draw into each other's picture."""
    with socket.socket() as probe:
        probe.bind((_LOCALHOST, 0))
        return int(probe.getsockname()[1])


def _finish(stream: Any) -> None:
    try:
        stream.flush(timeout_sec=_FLUSH_S)
    finally:
        stream.disconnect()


def _shade(patch: GridPatch) -> NDArray[np.uint8]:
    """Grey of each cell (H, W): the likelier free, the lighter."""
    grey = np.round(2.55 * (100.0 - np.clip(patch.cells, 0, 100)))
    return np.where(patch.cells == UNKNOWN, _UNKNOWN_GREY, grey).astype(np.uint8)


def _rgb(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


def _lifted(points: Array, z: float) -> NDArray[np.float32]:
    """Points (N, 2) at a height, (N, 3)."""
    return np.column_stack([points, np.full(len(points), z)]).astype(np.float32)


def _ellipse(centre: Array, covariance: Array) -> Array:
    """Outline (N, 2) within which a place with this covariance (2, 2) lies in 95 of 100 cases."""
    values, vectors = np.linalg.eigh(covariance)
    angles = np.linspace(0.0, 2.0 * np.pi, _OUTLINE)
    axes = vectors * np.sqrt(_SIGMA2_95 * np.maximum(values, 0.0))
    return np.asarray(centre + np.column_stack([np.cos(angles), np.sin(angles)]) @ axes.T)
