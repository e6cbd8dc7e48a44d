"""Doors hardly wider than the robot, at many angles: the planner passes what the graph passes."""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.rows import Row, at_least, at_most
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.grid_search import path_collides
from thinmap_ros.core.planning.wavefront import WavefrontConfig, plan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import build

_ROOM_M = 8.0
_WALL_M = 0.2
_DOOR_M = 0.7
_FROM_WALL_M = 2.0
_RADII_M = (0.25, 0.3, 0.35)
_ANGLES_DEG = (0.0, 10.0, 22.5, 30.0, 45.0)
_OFFSETS_M = (0.0, 0.012, 0.025, 0.037)
_NOISE = 0.2  # share of the cells beside walls that are occupied as well


def oblique_door(
    angle_deg: float, offset_m: float, resolution: float, noise: float
) -> tuple[GridPatch, Array]:
    """A room with a wall at an angle through its middle, and a door in it.

    Also a point (2,), m, on one side of the door; its opposite lies on the other side.
    """
    count = round(_ROOM_M / resolution)
    centres = (np.arange(count) + 0.5) * resolution - 0.5 * _ROOM_M
    x, y = np.meshgrid(centres, centres)
    across = np.array([math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))])
    off_wall = np.abs(across[0] * x + across[1] * y)
    off_door = np.abs(across[0] * y - across[1] * x - offset_m)
    occupied = (off_wall < 0.5 * _WALL_M) & (off_door > 0.5 * _DOOR_M)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    padded = np.pad(occupied, 1, mode='edge')
    beside = padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
    rng = np.random.default_rng(round(1000 * offset_m))
    occupied |= beside & (rng.random(occupied.shape) < noise)
    frame = GridFrame(-0.5 * _ROOM_M, -0.5 * _ROOM_M, resolution)
    return GridPatch(frame, np.where(occupied, 100, 0).astype(np.int8)), _FROM_WALL_M * across


def pass_door(patch: GridPatch, point: Array, radius_m: float) -> tuple[bool, Array | None]:
    """Whether the graph leads through the door, and the path (K, 2) of the planner, if any."""
    start, goal = ((float(at[0]), float(at[1])) for at in (-point, point))
    graph = build(patch, start, TopologyConfig(robot_radius_m=radius_m))
    along = [float(node.position @ point) for node in graph.nodes.values()]
    is_beyond = [part > _FROM_WALL_M for part in along]
    is_before = [part < -_FROM_WALL_M for part in along]
    path = plan(patch, start, goal, WavefrontConfig(robot_radius_m=radius_m))
    return any(is_beyond) and any(is_before), path


def run(_worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows for doors of 0.7 m, on cells of 5 and 10 cm, with and without noise at the walls."""
    in_graph = 0
    in_both = 0
    too_near = 0
    cases = list(itertools.product((0.05, 0.1), _RADII_M, (0.0, _NOISE), _ANGLES_DEG, _OFFSETS_M))
    chosen = cases[:: 6 if quick else 1]
    for resolution, radius_m, noise, angle_deg, offset_m in chosen:
        patch, point = oblique_door(angle_deg, offset_m, resolution, noise)
        is_through, path = pass_door(patch, point, radius_m)
        in_graph += is_through
        in_both += is_through and path is not None
        too_near += path is not None and path_collides(patch, path, radius_m)
    yield Row('doors of 0.7 m', f'{len(chosen)} cases')
    yield Row('  passed by the graph', f'{in_graph}')
    yield at_least('  of these, passed by the planner, share', in_both / max(in_graph, 1), 1.0)
    yield at_most('  paths nearer to a wall than the radius', too_near, 0)
