"""Messages of the robot as items of the page."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from thinmap_ros.core import errors
from thinmap_ros.core.errors import InputError, one_line
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.path_follower import Motion
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.core.topology.regions import RegionKind
from thinmap_ros.logs import decode
from thinmap_ros.view import palette
from thinmap_ros.view.interface import ApartScans, StampMatcher
from thinmap_ros.web import key, words
from thinmap_ros.web.board import Board
from thinmap_ros.web.diagnostics_table import DiagnosticsTable
from thinmap_ros.web.driven_path import DrivenPath
from thinmap_ros.web.map_tiles import MapTiles

_MAX_PATH_POINTS = 500
_MAX_APART_POINTS = 20_000
_EDGE_STEP = 4  # points of an edge are a cell apart
_KINDS = {int(kind): kind for kind in RegionKind}


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
        self._pairs: StampMatcher[Array, Array] = StampMatcher()
        board.put('key', key.colours())

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
        self._laser(self._pairs.add_left(ns, T_map_base))

    def scan(self, scan: Scan) -> None:
        """Show the points of a scan, once the pose at its stamp is known."""
        self._laser(self._pairs.add_right(scan.stamp_ns, scan.points_base()))

    def _laser(self, pair: tuple[Array, Array] | None) -> None:
        if pair is None:
            return
        T_map_base, points = pair
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
        shown = [_region(region) for region in message.regions]
        self.centres = {region['id']: tuple(region['center']) for region in shown}
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
        shown = []
        for node in message.end_nodes:
            place = (node.position.x, node.position.y)
            errors.require_bounded(f'end node {node.node_id}', place)
            probability = float(node.position_probability)
            errors.require_bounded(f'probability of {node.node_id}', (probability,), 1.0)
            x, y = (round(number, 2) for number in place)
            shown.append([node.node_id, x, y, round(probability, 2), bool(node.is_target)])
        self.board.put('end_nodes', shown)

    def plan(self, message: Any) -> None:
        """Show the planned path, a nav_msgs/Path. Raises InputError where a number is invalid."""
        points = np.array(
            [[p.pose.position.x, p.pose.position.y] for p in message.poses], dtype=np.float64
        ).reshape(-1, 2)
        errors.require_bounded('plan', points.ravel().tolist())
        step = -(-len(points) // _MAX_PATH_POINTS) or 1
        points = np.vstack([points[:-1:step], points[-1:]])
        self.board.put('plan', np.round(points, 2).ravel().tolist())

    def slam(self, message: Any) -> None:
        """Show a thinmap_msgs/SlamStatus."""
        inliers = float(message.inlier_ratio)
        step_ms = float(message.step_time_ms)
        errors.require_bounded('inlier_ratio, step_time_ms', (inliers, step_ms))
        shown = words.slam_words(message)
        self.board.put('slam', {**shown, 'inliers': round(inliers, 3), 'step_ms': round(step_ms)})

    def localized_scan(self, message: Any) -> None:
        """Show the scan of a thinmap_msgs/LocalizedScan that is mapped apart, if it is."""
        if self._apart.update(message):
            points = self._apart.points[-_MAX_APART_POINTS:]
            self.board.put('apart', np.round(points, 2).ravel().tolist())

    def exploration(self, message: Any) -> None:
        """Show a thinmap_msgs/ExplorationStatus."""
        self.board.put('exploration', words.exploration_words(message))

    def diagnostics(self, message: Any) -> None:
        """Take a diagnostic_msgs/DiagnosticArray into the table."""
        self._table.update(message.status)

    def tick(self) -> None:
        """Show what changes by time alone; called about once a second."""
        self.board.put('diagnostics', self._table.rows())


def _region(region: Any) -> dict[str, Any]:
    if region.kind not in _KINDS:
        raise InputError(f'region {region.id}: kind {region.kind}: expected 0 to 2')
    center = (region.center.x, region.center.y)
    errors.require_bounded(f'region {region.id}', (*center, region.area_m2))
    kind = _KINDS[region.kind]
    return {
        'id': int(region.id),
        'name': one_line(region.name) or f'{kind.name.lower()} {region.id}',
        'area': round(float(region.area_m2), 1),
        'center': [round(number, 2) for number in center],
        'colour': palette.region(kind, int(region.id)),
        'outline': np.round(decode.outline(region), 2).ravel().tolist(),
    }
