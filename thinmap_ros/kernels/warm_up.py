"""Warm-up of each algorithm in a small room, so that kernels are loaded before the first step.

A node warms up before it subscribes: otherwise a robot loses its first seconds, and a simulation
faster than real time many more. Each warm-up imports its own modules only, so that a node does not
load the kernels of others.
"""

from collections.abc import Iterator

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.frame import GridFrame
from thinmap_ros.core.grid.patch import UNKNOWN, GridPatch
from thinmap_ros.core.grid.raytrace import cast_rays
from thinmap_ros.core.odometry import OdometryAnchor
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array

_CELL_M = 0.1
_RANGE_M = 8.0
_BEAMS = 181
_ROOM_CELLS = 80
_PASSAGE = slice(30, 50)
_SCANS = 12
_PERIOD_S = 0.2
_STEP_M = 0.12
_TURN_RAD = 0.11


def localizer() -> None:
    """Warm up localization."""
    from thinmap_ros.core.slam.graph.keyframes import covariances_from
    from thinmap_ros.core.slam.graph.pose_graph import Edge
    from thinmap_ros.core.slam.localizer import Localizer

    rehearsed = Localizer()
    for scan, T_map_base in _drive():
        rehearsed.step(scan, T_map_base)
    # Also the search for a scan without a match, and the start from a loaded map.
    rehearsed.step(_odd_scan(), T_map_base)
    Localizer.from_state(rehearsed.state())
    Localizer.from_occupancy_map(_room(), OdometryAnchor(0, T_map_base, T_map_base), T_map_base)
    # A revisit needs covariances along the graph.
    covariances_from(0, np.zeros((2, 3)), [Edge(0, 1, np.zeros(3), np.eye(3), False)], np.ones(2))


def grid_mapper() -> None:
    """Warm up the map update and its windows."""
    from thinmap_ros.core.grid.occupancy import OccupancyGrid, WindowConfig

    rehearsed = OccupancyGrid()
    for scan, T_map_base in _drive():
        rehearsed.add_scan(scan, T_map_base)
        rehearsed.window(T_map_base[0], T_map_base[1], WindowConfig().local_map_size_m)
    rehearsed.known_area()


def topology_builder() -> None:
    """Warm up thinning and the merging of local maps."""
    from thinmap_ros.core.grid.occupancy import OccupancyGrid, WindowConfig
    from thinmap_ros.core.topology.builder import TopologyBuilder

    grid = OccupancyGrid()
    rehearsed = TopologyBuilder()
    for scan, T_map_base in _drive():
        grid.add_scan(scan, T_map_base)
        rehearsed.update(
            grid.window(T_map_base[0], T_map_base[1], WindowConfig().local_map_size_m), T_map_base
        )
        rehearsed.local_map()


def explorer() -> None:
    """Warm up the choice of an end node, in a partly unknown room."""
    from thinmap_ros.core.exploration.explorer import Explorer
    from thinmap_ros.core.topology.builder import TopologyConfig, build

    patch = _room()
    rehearsed = Explorer()
    topology = build(patch, (2.0, 2.0), TopologyConfig())
    for scan, T_map_base in _drive():
        rehearsed.step(topology, patch, scan, T_map_base)


def navigator() -> None:
    """Warm up planning and driving."""
    from thinmap_ros.core.planning.navigator import Navigator

    patch = _room()
    rehearsed = Navigator()
    rehearsed.set_goal(4.0, 3.0, 0.0)
    for scan, T_map_base in _drive():
        rehearsed.step(T_map_base, patch, scan, _PERIOD_S)


def global_localizer() -> None:
    """Warm up global localization."""
    from thinmap_ros.core.places.global_localizer import GlobalLocalization
    from thinmap_ros.core.topology.builder import TopologyConfig, build

    patch = _room()
    rehearsed = GlobalLocalization(patch, build(patch, (2.0, 2.0), TopologyConfig()))
    for scan, T_map_base in _drive():
        rehearsed.step(scan, T_map_base)


def _room() -> GridPatch:
    """A room with a pillar, and a passage to unknown space."""
    cells = np.zeros((_ROOM_CELLS, _ROOM_CELLS), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    cells[40:46, 40:46] = 100
    cells[_PASSAGE, -1] = 0
    cells[:, -20:-1] = UNKNOWN
    return GridPatch(GridFrame(0.0, 0.0, _CELL_M), cells)


def _odd_scan() -> Scan:
    """A scan of random ranges, which fits no room."""
    step = np.radians(180.0 / (_BEAMS - 1))
    ranges = 1.0 + np.arange(_BEAMS) * 0.37 % 3.0
    stamp_ns = round(1e9 * _PERIOD_S * _SCANS)
    return Scan.create(stamp_ns, ranges, -np.pi / 2.0, float(step), 0.05, _RANGE_M)


def _drive() -> Iterator[tuple[Scan, Array]]:
    """Scans along an arc through the room, each with its pose (3,)."""
    occupied = _room().occupied.astype(np.uint8)
    step = np.radians(180.0 / (_BEAMS - 1))
    angles = step * np.arange(_BEAMS) - np.pi / 2.0
    T_map_base = se2.pose(2.0, 2.0, 0.3)
    for k in range(_SCANS):
        x, y = T_map_base[:2] / _CELL_M
        ranges = _CELL_M * cast_rays(occupied, x, y, angles + T_map_base[2], _RANGE_M / _CELL_M)
        scan = Scan.create(
            round(1e9 * _PERIOD_S * k), ranges, float(angles[0]), float(step), 0.05, _RANGE_M
        )
        yield scan, T_map_base
        T_map_base = se2.compose(T_map_base, se2.pose(_STEP_M, 0.0, _TURN_RAD))
