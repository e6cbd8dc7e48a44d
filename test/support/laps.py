"""A robot that drives one way again and again through a small room."""

import numpy as np
from support.slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array, inverse
from thinmap_ros.core.slam.graph.keyframes import Keyframe, SavedKeyframes
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.slam.odometry import UNKNOWN

STEP = inverse(np.diag(np.square([0.01, 0.01, 0.003])))
LOOP = inverse(np.diag(np.square([0.05, 0.05, 0.02])))
WAY = [(x, 2.0, 0.0) for x in np.arange(1.0, 6.5, 0.7)] + [
    (6.3, y, np.pi / 2.0) for y in np.arange(2.0, 7.0, 0.7)
]


def keyframe(T: Array, path_m: float, walls: Array = ROOM) -> Keyframe:
    scan = scan_in(walls, T, np.random.default_rng(int(100.0 * path_m)))
    return Keyframe(scan, surface_points(scan), T, path_m, np.diag([0.01, 0.01, 0.001]), 0)


def driven(laps: int) -> SavedKeyframes:
    """Some drives along a way, 30 m of path apart, and loops from each to the one before."""
    count = len(WAY)
    rng = np.random.default_rng(7)
    frames = []
    for lap in range(laps):
        for k, (x, y, yaw) in enumerate(WAY):
            T = se2.pose(x, y, yaw) + rng.normal(0.0, [0.1, 0.1, 0.02])
            frames.append(keyframe(T, 30.0 * lap + 0.7 * k))
    poses = [frame.T_map_base for frame in frames]

    def edge(a: int, b: int, information: Array, robust: bool) -> Edge:
        T = se2.between(poses[a], poses[b])
        noise = rng.multivariate_normal(np.zeros(3), inverse(information))
        return Edge(a, b, T + noise, information, robust, inlier_ratio=0.8 if robust else 0.0)

    steps = [edge(k - 1, k, STEP, False) for k in range(1, len(frames))]
    for lap in range(1, laps):  # carried back
        steps[count * lap - 1] = edge(count * lap - 1, count * lap, inverse(UNKNOWN), False)
    edges = [edge(k - count, k, LOOP, True) for k in range(count, len(frames))]
    return SavedKeyframes(frames, steps, edges, [10 + k for k in range(len(frames))])
