"""Reliability of the nodes that a single scan shows, by scans simulated in the map."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.places.config import GlobalLocalizationConfig
from thinmap_ros.core.places.observation import observed_nodes
from thinmap_ros.core.places.place_database import FREE, NODE_WINDOW_M, Bytes, Places, free_way
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import NodeKind
from thinmap_ros.jit import kernel

_TRIALS = 60
_SAME_NODE_M = 1.0
_RAYLEIGH_MEDIAN = 1.1774  # median distance of points with 1 sigma on each axis
_VIEW_SHARE = 0.25  # of the active window: where an observed node may lie


@dataclass(frozen=True, eq=False)
class NodeModel:
    """What an observed node is worth, by its kind (3,).

    found: chance that the map has it; spread_m: 1 sigma of its place along each axis; gain: how
    much likelier its place is, right there, than anywhere.
    """

    found: Array
    spread_m: Array
    gain: Array


def calibrate(
    places: Places, like: Scan, config: GlobalLocalizationConfig, rng: np.random.Generator
) -> NodeModel:
    """Node model for a map and a laser.

    Scans are made in the map at random poses, and their nodes looked up in it.

    like: a scan of that laser. So the tolerance follows from the grid and the sensor: from the
    cells' size, the field of view, what a view from one side leaves unknown, and how the map's own
    nodes were made.
    """
    distances: list[list[float]] = [[] for _ in NodeKind]
    for _ in range(_TRIALS):
        T = random_pose(places, rng)
        nodes, kinds = observed_nodes(
            simulated_scan(places, T, like), places.frame.resolution, config
        )
        away = se2.transform_points(T, nodes)[:, None, :] - places.nodes[None]
        nearest = np.hypot(away[..., 0], away[..., 1]).min(axis=1)
        for kind, distance in zip(kinds.tolist(), nearest.tolist(), strict=True):
            distances[kind].append(distance)
    chance = _chance(places)
    window = _VIEW_SHARE * NODE_WINDOW_M**2
    found = np.zeros(len(NodeKind))
    spread = np.full(len(NodeKind), places.frame.resolution)
    for kind in NodeKind:
        all_of_it = np.array(distances[kind])
        near = all_of_it[all_of_it < _SAME_NODE_M]
        if near.size:
            found[kind] = max(0.0, (near.size / all_of_it.size - chance) / (1.0 - chance))
            spread[kind] = max(spread[kind], float(np.median(near)) / _RAYLEIGH_MEDIAN)
    # A few trials do not prove a rate near 1.
    return NodeModel(np.minimum(found, 0.9), spread, window / (2.0 * np.pi * spread**2))


def random_pose(places: Places, rng: np.random.Generator) -> Array:
    """Pose (3,) at which the robot can stand, each as likely as any other."""
    at = places.frame.centres_of(
        places.standing[rng.integers(len(places.standing))][None].astype(np.int64)
    )[0]
    return se2.pose(float(at[0]), float(at[1]), float(rng.uniform(-np.pi, np.pi)))


def simulated_scan(places: Places, T_map_base: Array, like: Scan) -> Scan:
    """The scan that a laser would make in the map, without noise.

    What is unknown lets nothing through.
    """
    T_map_laser = se2.compose(T_map_base, like.T_base_laser)
    resolution = places.frame.resolution
    x = (T_map_laser[0] - places.frame.origin_x) / resolution
    y = (T_map_laser[1] - places.frame.origin_y) / resolution
    ranges = resolution * _ways(
        places.states, x, y, T_map_laser[2] + like.angles_rad, like.range_max_m / resolution
    )
    return Scan.create(
        like.stamp_ns,
        ranges,
        like.angle_min_rad,
        like.angle_increment_rad,
        like.range_min_m,
        like.range_max_m,
        like.T_base_laser,
    )


def _chance(places: Places) -> float:
    """Share of the places in the map that have a node near by, whatever was observed."""
    some = places.spots[:: max(1, len(places.spots) // 1000)]
    away = some[:, None, :] - places.nodes[None]
    return float((np.hypot(away[..., 0], away[..., 1]).min(axis=1) < _SAME_NODE_M).mean()) * (
        1.0 - 1e-6
    )


@kernel
def _ways(states: Bytes, x: float, y: float, angles: Array, most: float) -> Array:
    """Cells to the first one that is not free, for each angle (N,); inf beyond `most`."""
    ways = np.full(angles.size, np.inf)
    for k in range(angles.size):
        way, state = free_way(states, x, y, angles[k], most)
        if state != FREE:
            ways[k] = way
    return ways
