"""Doors hardly wider than the robot, at many angles, and whether graph and planner pass them."""

import math

import numpy as np

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.wavefront import WavefrontConfig, plan
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import build

_ROOM_M = 8.0
_WALL_M = 0.2
_DOOR_M = 0.7
_FROM_WALL_M = 2.0


def oblique_door(angle_deg, offset_m, resolution, noise):
    """A room with a wall at an angle through its middle, and a door of 0.7 m in it.

    noise: share of the cells beside walls that are occupied as well. Also a point (2,), m, on one
    side of the door; its opposite lies on the other side.
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


def pass_door(patch, point, radius_m):
    """Whether the graph leads through the door, and the path (K, 2) of the planner, if any."""
    start, goal = ((float(at[0]), float(at[1])) for at in (-point, point))
    graph = build(patch, start, TopologyConfig(robot_radius_m=radius_m))
    along = [float(node.position @ point) for node in graph.nodes.values()]
    is_beyond = [part > _FROM_WALL_M for part in along]
    is_before = [part < -_FROM_WALL_M for part in along]
    path = plan(patch, start, goal, WavefrontConfig(robot_radius_m=radius_m))
    return any(is_beyond) and any(is_before), path
