"""What one scan shows: some of its beams, and the nodes of its own topological map."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.places.config import GlobalLocalizationConfig
from thinmap_ros.core.places.place_database import DIRECTIONS, NODE_WINDOW_M, RANGE_UNIT_M
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import build

# One scan alone has to make cells free and occupied.
_P_FREE = 0.2
_P_OCCUPIED = 0.8


@dataclass(frozen=True, eq=False)
class Observation:
    """Beams and nodes of one scan in the robot frame.

    laser (3,): its pose on the robot; ranges_m, bearings_rad (B,): beams from there, ranges cut at
    what is usable; ends (B, 2): where they end; met (B,): whether they met something there; nodes
    (K, 2): places of the nodes of the scan's topological map, and their kinds (K,).
    """

    laser: Array
    ranges_m: Array
    bearings_rad: Array
    ends: Array
    met: NDArray[np.bool_]
    nodes: Array
    node_kinds: NDArray[np.int64]


def observe(scan: Scan, resolution_m: float, config: GlobalLocalizationConfig) -> Observation:
    """Observation of a scan; the nodes are those of a grid with the map's resolution."""
    nodes, kinds = observed_nodes(scan, resolution_m, config)
    return replace(observed_beams(scan, config), nodes=nodes, node_kinds=kinds)


def observed_beams(scan: Scan, config: GlobalLocalizationConfig) -> Observation:
    """Observation of a scan without its nodes: beams alone."""
    usable = np.flatnonzero(scan.returned | scan.no_return)
    if usable.size > config.max_beams:
        usable = usable[
            np.linspace(0.0, usable.size - 1.0, config.max_beams).round().astype(np.int64)
        ]
    farthest = min(scan.range_max_m, scan.max_range_m, config.compared_range_m)
    met = scan.hit[usable] & (scan.ranges_m[usable] < farthest)
    ranges = np.where(met, scan.ranges_m[usable], farthest)
    bearings = scan.angles_rad[usable]
    ends = se2.transform_points(
        scan.T_base_laser, np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])
    )
    none = np.empty(0, dtype=np.int64)
    return Observation(scan.T_base_laser, ranges, bearings, ends, met, np.empty((0, 2)), none)


def observed_nodes(
    scan: Scan, resolution_m: float, config: GlobalLocalizationConfig
) -> tuple[Array, NDArray[np.int64]]:
    """Nodes (K, 2), robot frame, and their kinds (K,), of the topological map of one scan alone.

    Source: topological map paper section 2.1; the active window is a square round the robot.
    """
    half = NODE_WINDOW_M / 2.0
    grid = OccupancyGrid(
        OccupancyConfig(
            resolution_m=resolution_m,
            p_miss=_P_FREE,
            p_hit=_P_OCCUPIED,
            no_return_clear_range_m=half,
        )
    )
    grid.add_scan(replace(scan, max_range_m=min(scan.max_range_m, half)), np.zeros(3))
    window = grid.window(0.0, 0.0, NODE_WINDOW_M)
    topology = build(window, (0.0, 0.0), TopologyConfig(robot_radius_m=config.robot_radius_m))
    nodes = np.array([node.position for node in topology.nodes.values()]).reshape(-1, 2)
    return nodes, np.array([int(node.kind) for node in topology.nodes.values()], dtype=np.int64)


def profile(observation: Observation) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Range in each of DIRECTIONS round the robot.

    Ranges (DIRECTIONS,), m, which are known, and which met something.

    Direction k covers the bearings k / DIRECTIONS of a turn, robot frame; of several beams the one
    nearest to its middle counts. Ranges are cut at what `Places.around` can hold.
    """
    most = 254 * RANGE_UNIT_M
    away = observation.ends
    ranges = np.hypot(away[:, 0], away[:, 1])
    turns = np.arctan2(away[:, 1], away[:, 0]) * (DIRECTIONS / (2.0 * math.pi))
    bins = np.round(turns).astype(np.int64)
    result = np.full(DIRECTIONS, most)
    known = np.zeros(DIRECTIONS, dtype=np.bool_)
    met = np.zeros(DIRECTIONS, dtype=np.bool_)
    # The nearest to a direction's middle comes last and stays.
    for k in np.argsort(-np.abs(turns - bins), kind='stable').tolist():
        at = bins[k] % DIRECTIONS
        result[at] = min(ranges[k], most)
        known[at] = True
        met[at] = bool(observation.met[k]) and ranges[k] < most
    return result, known, met
