"""Pieces of the map of a generated building, each driven by a robot from an origin of its own."""

from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

import numpy as np

from benchmarks.buildings import BuildingConfig, generate_building
from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid
from thinmap_ros.core.places.piece import MapPiece
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.sim.drives import random_drive, random_start

_CONFIG = BuildingConfig(
    area_m2=350.0,
    hall_share=0.0,
    clutter=0.0,
    glass_share=0.0,
    wings=1,
    people_per_1000_m2=0.0,
    moving_doors=0.0,
)
KEYFRAME_M = 0.7


@dataclass(frozen=True, eq=False)
class DrivenPiece:
    """A piece, the pose (3,) of its origin in the world, and the edges of its path."""

    piece: MapPiece
    T_world_piece: np.ndarray
    edges: list[Edge]


@cache
def world_of(seed):
    return generate_building(seed, _CONFIG).world


@cache
def driven_piece(building, drive, path_m=60.0, drift=0.0):
    """A random drive through a building; drift: m of sideways error per metre of path."""
    world = world_of(building)
    start = random_start(world, np.random.default_rng([building, drive]))
    grid = OccupancyGrid(replace(PAPER_GRID, no_return_clear_range_m=8.0))
    frames = []
    driven_m = 0.0
    last = start
    for sample in random_drive(world, start, drive):
        step_m = float(np.hypot(*(sample.T_world_base - last)[:2]))
        driven_m += step_m
        last = sample.T_world_base
        T_map_base = se2.between(start, last)
        T_map_base[1] += drift * driven_m
        grid.add_scan(sample.scan, T_map_base)
        if not frames or driven_m - frames[-1].path_m >= KEYFRAME_M:
            points = surface_points(sample.scan)
            frames.append(
                Keyframe(sample.scan, points, T_map_base, driven_m, np.zeros((3, 3)), submap=0)
            )
        if driven_m > path_m:
            break
    patch = grid.known_area()
    piece = MapPiece(frames, patch, build(patch, None, TopologyConfig()))
    return DrivenPiece(piece, start, steps_of(frames))


def steps_of(frames):
    """Edges along a path."""
    information = np.diag([1.0 / 0.02**2, 1.0 / 0.02**2, 1.0 / 0.005**2])
    return [
        Edge(k, k + 1, se2.between(a.T_map_base, b.T_map_base), information, robust=False)
        for k, (a, b) in enumerate(pairwise(frames))
    ]


def true_transform(known, query):
    """Pose (3,) of the origin of a driven piece in another one of the same building."""
    return se2.between(known.T_world_piece, query.T_world_piece)
