"""The numbers that sum up an exploration, from plain arrays: the same for the simulator and for the live graph."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from thinmap_ros.core.exploration.explorer import EndNode
from thinmap_ros.core.exploration.position_probability import NEAR_M
from thinmap_ros.core.se2 import Array

MILESTONES = (0.90, 0.95, 0.98, 0.99)


@dataclass
class EndNodeCensus:
    """Which end nodes there ever were, and to which of them the robot came near."""

    seen: set[int] = field(default_factory=set)
    visited: set[int] = field(default_factory=set)

    def take(self, end_nodes: Sequence[EndNode], T_map_base: Array) -> None:
        """Count the end nodes of a decision made at a pose (3,); nearer than 0.5 m is a visit (equation (2))."""
        for node in end_nodes:
            self.seen.add(node.node_id)
            if (node.x - T_map_base[0]) ** 2 + (node.y - T_map_base[1]) ** 2 < NEAR_M**2:
                self.visited.add(node.node_id)


@dataclass(frozen=True)
class Ending:
    """How an exploration ended: whether by itself, why, and how often the robot touched something."""

    finished: bool
    reason: str
    collisions: int


def exploration_report(
    ending: Ending, times_s: Array, true_poses: Array, estimated_poses: Array, coverage: Array, census: EndNodeCensus
) -> dict[str, Any]:
    """Report of an exploration, ready for JSON.

    times_s (N,): from the start on; true_poses, estimated_poses (N, 3): at these times, in the same frame; coverage
    (M, 2): time in s and coverage, 0 to 1, whenever it was measured. distance and the times and distances at which a
    coverage was first measured are of the true path, in m and s; None where it was not reached.
    """
    steps = np.hypot(*np.diff(true_poses[:, :2], axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    times_at = {f'{share:.2f}': _first_time(coverage, share) for share in MILESTONES}
    distances_at = {
        share: None if time is None else round(float(np.interp(time, times_s, along)), 3)
        for share, time in times_at.items()
    }
    errors = np.hypot(*(estimated_poses[:, :2] - true_poses[:, :2]).T)
    return {
        'finished': ending.finished,
        'reason': ending.reason,
        'coverage': round(float(coverage[-1, 1]), 5),
        'distance': round(float(along[-1]), 3),
        'time': round(float(times_s[-1] - times_s[0]), 3),
        'distance_at': distances_at,
        'time_at': times_at,
        'collisions': ending.collisions,
        'end_nodes_seen': len(census.seen),
        'end_nodes_visited': len(census.visited),
        'pose_rmse': round(float(np.sqrt(np.mean(errors**2))), 5),
        'turned_rad': round(float(np.abs(_turns(true_poses)).sum()), 2),
    }


def _first_time(coverage: Array, share: float) -> float | None:
    reached = np.flatnonzero(coverage[:, 1] >= share)
    return round(float(coverage[reached[0], 0]), 3) if reached.size else None


def _turns(poses: Array) -> Array:
    turns = np.diff(poses[:, 2])
    return np.asarray((turns + np.pi) % (2.0 * np.pi) - np.pi)
