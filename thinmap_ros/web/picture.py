"""Messages of the robot as items of the page."""

import base64
import math
import zlib
from collections.abc import Iterable, Iterator
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import errors, se2
from thinmap_ros.core.errors import one_line
from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.path_follower import Motion
from thinmap_ros.core.scan import Scan, with_newest
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap
from thinmap_ros.logs import decode
from thinmap_ros.view import palette
from thinmap_ros.view.interface import ApartScans, StampMatcher
from thinmap_ros.web.pages import Board

_LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
_STALE = 3
_SILENT_S = 5.0
_MAX_ROWS = 100
ENDED = 'ended'  # the last message of a node, as in thinmap_ros.ros.diagnostics


class DiagnosticsTable:
    """The newest level, name and message of each node, the worst first; a silent one is stale.

    One that has ended in order is not.
    """

    def __init__(self) -> None:
        self._rows: dict[str, tuple[float, int, str]] = {}

    def update(self, statuses: Iterable[Any], now_s: float | None = None) -> None:
        """Replace the rows of some diagnostic_msgs/DiagnosticStatus; now_s: monotonic time, s."""
        now_s = monotonic() if now_s is None else now_s
        for status in statuses:
            name = one_line(status.name)
            if name in self._rows or len(self._rows) < _MAX_ROWS:
                level = min(_level(status.level), _STALE)
                self._rows[name] = (now_s, level, one_line(status.message))

    def rows(self, now_s: float | None = None) -> list[list[str]]:
        """Level, name and message of each row, the worst first; now_s: monotonic time, s."""
        now_s = monotonic() if now_s is None else now_s
        rows = [
            (_STALE, name, 'silent')
            if now_s - heard_s > _SILENT_S and message != ENDED
            else (level, name, message)
            for name, (heard_s, level, message) in self._rows.items()
        ]
        rows.sort(key=lambda row: (-row[0], row[1]))
        return [[_LEVELS[level], name, message] for level, name, message in rows]


def _level(level: bytes | int) -> int:
    return level[0] if isinstance(level, bytes) else int(level)


_STEP_M = 0.2
_PIECE = 100  # points


class DrivenPath:
    """Puts the path of the robot on a board in pieces; a correction replaces it up to its stamp."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._points: list[tuple[int, float, float]] = []

    @property
    def start(self) -> tuple[float, float] | None:
        """Where the path begins, m; None without a path."""
        return self._points[0][1:] if self._points else None

    def add(self, stamp_ns: int, x: float, y: float) -> None:
        """Add a place, m, unless the robot has hardly moved."""
        if self._points:
            last_ns, last_x, last_y = self._points[-1]
            if math.hypot(x - last_x, y - last_y) < _STEP_M:
                return
            # A pose of a scan with a delay is stamped earlier than the trajectory that follows.
            if stamp_ns < last_ns - SECOND_NS:
                self._points = []  # time was set back
        self._points.append((stamp_ns, x, y))
        # The piece before ends with the first point of the next one.
        self._show(first=max((len(self._points) - 2) // _PIECE, 0))

    def correct(self, stamps_ns: NDArray[np.int64], poses: Array) -> None:
        """Replace the path up to the last of the stamps (N,) by poses (N, 3)."""
        places = poses[:, :2].tolist()
        corrected = [
            (stamp_ns, x, y) for stamp_ns, (x, y) in zip(stamps_ns.tolist(), places, strict=True)
        ]
        end_ns = corrected[-1][0] if corrected else 0
        self._points = corrected + [point for point in self._points if point[0] > end_ns]
        self._show()

    def _show(self, first: int = 0) -> None:
        """Show the pieces from the first that has changed on."""
        starts = range(0, len(self._points), _PIECE)
        self._board.keep('path/', {f'path/{start // _PIECE}' for start in starts})
        for start in starts[first:]:
            # A point more, so that no gap is between two pieces.
            part = self._points[start : start + _PIECE + 1]
            xy = [round(number, 2) for _, x, y in part for number in (x, y)]
            self._board.put(f'path/{start // _PIECE}', xy)
        self._board.put('path', len(starts))


def key() -> dict[str, dict[str, list[str]]]:
    """Colours of what is drawn, as in summary.png, by layer and by name on the page.

    Those of the cells of the map are the page's own, as they depend on its theme.
    """
    rooms = {kind.name.lower(): list(shades) for kind, shades in palette.REGIONS.items()}
    return {
        'regions': rooms,
        'graph': {
            'end node': [palette.NODES[NodeKind.END]],
            'branch node': [palette.NODES[NodeKind.BRANCH]],
            'corner node': [palette.NODES[NodeKind.CORNER]],
            'edge': [palette.EDGE],
        },
        'end nodes': {'p: probability that its position is final': []},
        'path': {'robot and its path': [palette.ESTIMATE], 'other robots': [palette.ROBOTS[4]]},
        'laser': {'laser': [palette.PALETTE[5]], 'mapped apart': [palette.APART]},
        'plan': {'plan and goal': [palette.TRUTH]},
        'keep out': {'keep out': [palette.KEEP_OUT], 'limit of the exploration': [palette.HIDDEN]},
    }


_SIDE = 128  # cells
_UNKNOWN = 0
_FREE = 1
_OCCUPIED = 2
_LEVEL = 1  # of compression: the fastest
Classes = NDArray[np.uint8]


class MapTiles:
    """Puts the tiles of a map on a board; a page receives those in which cells have changed.

    Tiles lie on the lattice of the cells whatever the origin of the map, which moves as it grows.
    """

    def __init__(self, board: Board) -> None:
        self._board = board
        self._lattice: tuple[float, float, float] | None = None
        self._generation = 0
        self._tiles: dict[tuple[int, int], bytes] = {}

    def show(self, patch: GridPatch) -> None:
        """Show a map: tiles that it no longer has, or another lattice, begin a new map."""
        row, col, lattice = _place(patch.frame)
        tiles = dict(_tiles(_classes(patch), row, col))
        if lattice != self._lattice or self._tiles.keys() - tiles.keys():
            self._lattice = lattice
            self._generation += 1
            self._tiles = {}
            self._board.keep('tile/', set())
            self._board.put('map', self._head(lattice))
        for place, classes in tiles.items():
            content = classes.tobytes()
            if self._tiles.get(place) != content:
                self._tiles[place] = content
                packed = base64.b64encode(zlib.compress(content, _LEVEL)).decode()
                self._board.put(f'tile/{place[0]}/{place[1]}', packed)

    def _head(self, lattice: tuple[float, float, float]) -> dict[str, float]:
        resolution, x, y = lattice
        return {
            'generation': self._generation,
            'resolution': resolution,
            'x': x,
            'y': y,
            'side': _SIDE,
        }


def _place(frame: GridFrame) -> tuple[int, int, tuple[float, float, float]]:
    """Row and column of cell (0, 0) on the lattice, and resolution and origin of that lattice."""
    resolution = frame.resolution
    col = round(frame.origin_x / resolution)
    row = round(frame.origin_y / resolution)
    x = round(frame.origin_x - col * resolution, 4)
    y = round(frame.origin_y - row * resolution, 4)
    return row, col, (resolution, x, y)


def _classes(patch: GridPatch) -> Classes:
    classes = np.full(patch.shape, _UNKNOWN, dtype=np.uint8)
    classes[patch.free] = _FREE
    classes[patch.occupied] = _OCCUPIED
    return classes


def _tiles(classes: Classes, row: int, col: int) -> Iterator[tuple[tuple[int, int], Classes]]:
    """Tiles that hold known cells, by their row and column among the tiles."""
    rows, cols = classes.shape
    for tile_row in range(row // _SIDE, -(-(row + rows) // _SIDE)):
        for tile_col in range(col // _SIDE, -(-(col + cols) // _SIDE)):
            first_row = tile_row * _SIDE - row
            first_col = tile_col * _SIDE - col
            part = classes[
                max(first_row, 0) : max(first_row + _SIDE, 0),
                max(first_col, 0) : max(first_col + _SIDE, 0),
            ]
            if not part.any():
                continue
            tile = np.full((_SIDE, _SIDE), _UNKNOWN, dtype=np.uint8)
            at_row = max(-first_row, 0)
            at_col = max(-first_col, 0)
            tile[at_row : at_row + part.shape[0], at_col : at_col + part.shape[1]] = part
            yield (tile_row, tile_col), tile


_STATES = ('TRACKING', 'LOST', 'BLIND', 'NO MAP', 'MISALIGNED', 'MAPPING APART')
_DETAILS = (
    'the laser confirms the pose',
    'the place of the robot in the map is unknown',
    'the laser does not confirm the pose: odometry alone',
    'no map to match: odometry alone',
    'the laser is turned on the robot: its scans are not mapped',
    'lost: a piece of its own is mapped',
)
_MAPPING_APART = 5
_DOING = ('idle', 'exploring', 'returning')
_ENDINGS = {1: 'finished', 3: 'cancelled'}  # by ExplorationStatus.reason_code


def slam_words(message: Any) -> dict[str, Any]:
    """State of a thinmap_msgs/SlamStatus, and why."""
    state = min(int(message.state), len(_STATES) - 1)
    detail = _DETAILS[state]
    if state == _MAPPING_APART:
        odds = float(message.join_odds)
        place = f'best place at odds of {odds:.3g} to 1' if odds > 0.0 else 'no place is found yet'
        detail = f'{detail}, {message.apart_m:.1f} m so far; {place}'
    if message.is_contradicted:
        detail += '; scans contradict the map'
    return {'state': _STATES[state], 'detail': detail, 'is_well': state == 0}


def exploration_words(message: Any) -> dict[str, Any]:
    """Progress of a thinmap_msgs/ExplorationStatus."""
    state = int(message.state)
    doing = _DOING[state] if state < len(_DOING) else _ENDINGS.get(message.reason_code, 'ended')
    words = [f'{message.distance_m:.1f} m']
    if message.has_target:
        place = message.target_position
        is_frontier = message.target_id >= FIRST_FRONTIER_ID
        what = 'a frontier' if is_frontier else f'end node {message.target_id}'
        words.append(f'to {what} at {place.x:.1f}, {place.y:.1f}')
    if message.state != 0:
        words += _missing(message)
    if message.reason not in ('', doing):
        words.append(message.reason)
    return {
        'state': doing,
        'detail': ', '.join(words),
        'coverage': _finite(message.coverage_estimate),
        'distance': _finite(message.distance_m),
    }


def _missing(message: Any) -> list[str]:
    missing = float(message.missing_area_m2)
    bound = float(message.missing_area_bound_m2)
    if not missing >= 0.0:
        return []
    return [f'{missing:.0f} m2 missing, with 95 % no more than {bound:.0f} m2']


def _finite(number: float) -> float:
    return round(float(number), 4) if math.isfinite(number) else 0.0


_MAX_PATH_POINTS = 500
_MAX_APART_POINTS = 20_000
_EDGE_STEP = 4  # points of an edge are a cell apart


class Picture:
    """Shows what the robot publishes on a board.

    centres: place (x, y) of each region by its id, m, where a robot can stand.
    """

    def __init__(self, board: Board) -> None:
        self.board = board
        self.centres: dict[int, tuple[float, float]] = {}
        self.path = DrivenPath(board)
        self._tiles = MapTiles(board)
        self._table = DiagnosticsTable()
        self._apart = ApartScans()
        self._is_localized = False
        self._scanned_s: float | None = None  # when the localizer last said its state
        self._pairs: dict[str, StampMatcher[Array, Scan]] = {}  # by the frame of the laser
        self._scans: tuple[Scan, ...] = ()
        self._poses: dict[str, Array] = {}  # of the robot, when they were made
        board.put('key', key())

    def grid(self, patch: GridPatch) -> None:
        """Show a map."""
        self._tiles.show(patch)

    def pose(self, ns: int, T_map_base: Array, covariance: Array) -> None:
        """Show the pose (3,) of the robot with its covariance (3, 3) at a stamp, ns."""
        x, y, theta = T_map_base.tolist()
        spread = [covariance[0, 0], covariance[0, 1], covariance[1, 1], covariance[2, 2]]
        self.board.put(
            'robot',
            {
                'pose': [round(x, 3), round(y, 3), round(theta, 4)],
                'covariance': [float(f'{number:.3g}') for number in spread],
            },
        )
        self.path.add(ns, x, y)
        for pairs in self._pairs.values():
            self._laser(pairs.add_left(ns, T_map_base))

    def scan(self, scan: Scan) -> None:
        """Show the points of a scan, once the pose at its stamp is known.

        Unless its localizer publishes both at once: the stamp of its pose may be another one.
        """
        if self._is_localized:
            return
        pairs = self._pairs.setdefault(scan.frame, StampMatcher())
        self._laser(pairs.add_right(scan.stamp_ns, scan))

    def _laser(self, pair: tuple[Array, Scan] | None) -> None:
        """Show a scan at a pose (3,), with the newest one of each other laser."""
        if pair is None:
            return
        T_map_base, scan = pair
        self._scans = with_newest(self._scans, scan)
        self._poses[scan.frame] = T_map_base
        points = np.concatenate(
            [
                se2.transform_points(
                    se2.between(T_map_base, self._poses[each.frame]), each.points_base()
                )
                for each in self._scans
            ]
        )
        self.board.put(
            'laser',
            {
                'pose': [round(number, 4) for number in T_map_base.tolist()],
                'points_cm': np.rint(100.0 * points).astype(np.int64).ravel().tolist(),
            },
        )

    def robots(self, motions: Iterable[Motion]) -> None:
        """Show where other robots are, in the map of this one."""
        shown = []
        for motion in motions:
            x, y, theta = motion.pose.tolist()
            shown.append([motion.robot.strip('/'), round(x, 2), round(y, 2), round(theta, 3)])
        self.board.put('robots', shown)

    def topology(self, topology: TopologicalMap) -> None:
        """Show a graph: of its edges a page receives those that changed."""
        for edge in topology.edges.values():
            path = edge.path
            points = np.vstack([path[:-1:_EDGE_STEP], path[-1:]])
            self.board.put(f'edge/{edge.id}', np.round(points, 2).ravel().tolist())
        self.board.keep('edge/', {f'edge/{number}' for number in topology.edges})
        nodes = [
            [node.id, node.kind.name.lower(), round(node.x, 2), round(node.y, 2)]
            for node in topology.nodes.values()
        ]
        self.board.put('graph', {'nodes': nodes, 'edges': list(topology.edges)})

    def regions(self, message: Any) -> None:
        """Show a thinmap_msgs/RegionArray. Raises InputError where it is invalid."""
        regions = decode.regions(message)
        shown = [
            {
                'id': region.id,
                'name': region.name,
                'area': round(region.area_m2, 1),
                'center': [round(number, 2) for number in region.centre],
                'colour': palette.region(region.kind, region.id),
                'outline': np.round(region.outline, 2).ravel().tolist(),
            }
            for region in regions
        ]
        self.centres = {region.id: region.centre for region in regions}
        self.board.put('regions', shown)

    def keep_out(self, message: Any) -> None:
        """Show a thinmap_msgs/KeepOut. Raises InputError where it is invalid."""
        shown = [
            {
                'id': area.id,
                'name': str(area),
                'is_wall': area.is_wall,
                'corners': np.round(area.corners, 2).ravel().tolist(),
            }
            for area in decode.keep_out(message).areas
        ]
        self.board.put('keep_out', shown)

    def end_nodes(self, message: Any) -> None:
        """Show a thinmap_msgs/EndNodeArray. Raises InputError where a number is invalid."""
        shown = [
            [node.id, *(round(number, 2) for number in node[1:4]), node.is_target]
            for node in decode.end_nodes(message)
        ]
        self.board.put('end_nodes', shown)

    def plan(self, message: Any) -> None:
        """Show the planned path, a nav_msgs/Path. Raises InputError where a number is invalid."""
        points = decode.path(message)
        step = -(-len(points) // _MAX_PATH_POINTS) or 1
        points = np.vstack([points[:-1:step], points[-1:]])
        self.board.put('plan', np.round(points, 2).ravel().tolist())

    def no_plan(self) -> None:
        """Show no planned path."""
        self.board.put('plan', [])

    def slam(self, message: Any) -> None:
        """Show a thinmap_msgs/SlamStatus."""
        self._scanned_s = monotonic()
        inliers = float(message.inlier_ratio)
        step_ms = float(message.step_time_ms)
        errors.require_bounded('inlier_ratio, step_time_ms', (inliers, step_ms))
        shown = slam_words(message)
        self.board.put('slam', {**shown, 'inliers': round(inliers, 3), 'step_ms': round(step_ms)})

    def localized_scan(self, message: Any) -> None:
        """Show the scan of a thinmap_msgs/LocalizedScan, also with those that are mapped apart."""
        self._is_localized = True
        T_map_base = decode.checked_pose(message.pose.pose)
        T_base_laser = decode.pose(message.laser_pose)
        scan = decode.scan(message.scan, decode.stamp_ns(message), T_base_laser)
        self._laser((T_map_base, scan))
        if self._apart.update(message):
            points = self._apart.points[-_MAX_APART_POINTS:]
            self.board.put('apart', np.round(points, 2).ravel().tolist())

    def exploration(self, message: Any) -> None:
        """Show a thinmap_msgs/ExplorationStatus."""
        self.board.put('exploration', exploration_words(message))

    def diagnostics(self, message: Any) -> None:
        """Take a diagnostic_msgs/DiagnosticArray into the table."""
        self._table.update(message.status)

    def tick(self) -> None:
        """Show what changes by time alone; called about once a second."""
        self.board.put('diagnostics', self._table.rows())
        if self._scanned_s is not None:
            self.board.put('scan_age', int(monotonic() - self._scanned_s))
