"""Loop-closure candidates that agree on the same correction.

Source: Mangelson et al., "Pairwise consistent measurement set maximization for robust multi-robot
map merging", 2018.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import inverse
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.odometry import CHI2


def largest_consistent(candidates: Iterable[Edge], frames: Sequence[Keyframe]) -> list[Edge]:
    """Largest set of candidates that agree on the same correction (greedy).

    Of keyframes that are in the graph; none if two of the set are of the same keyframe.
    """
    edges = [edge for edge in candidates if edge.b < len(frames)]
    if not edges:
        return []
    n = len(edges)
    agree = np.eye(n, dtype=np.bool_)
    for i in range(n):
        for j in range(i):
            agree[i, j] = agree[j, i] = _are_consistent(edges[i], edges[j], frames)
    best: list[int] = []
    for i in range(n):
        chosen = [i]
        for j in np.argsort(-agree.sum(axis=0)):
            if j != i and all(agree[j, k] for k in chosen):
                chosen.append(int(j))
        best = max(best, chosen, key=len)
    return [edges[i] for i in best] if len({edges[i].b for i in best}) == len(best) else []


def _are_consistent(one: Edge, other: Edge, frames: Sequence[Keyframe]) -> bool:
    """Whether the loop over two matches and the path between them closes within the gate."""
    if one.b == other.b:
        return False
    T_a_a = se2.between(frames[one.a].T_map_base, frames[other.a].T_map_base)
    T_b_b = se2.between(frames[one.b].T_map_base, frames[other.b].T_map_base)
    there = se2.compose(one.T_a_b, T_b_b)
    back = se2.compose(T_a_a, other.T_a_b)
    off = se2.pose_difference(there, back)
    covariance = inverse(one.information) + inverse(other.information)
    covariance[2, 2] += 1e-6
    return float(off @ np.linalg.solve(covariance, off)) < CHI2
