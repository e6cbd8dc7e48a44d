"""Paths laid onto each other."""

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array


def between_paths(path: Array, onto: Array) -> Array:
    """Rigid motion (3,) that lays a path (N, 3) onto another: least squares of the positions."""
    middle = path[:, :2].mean(axis=0)
    onto_middle = onto[:, :2].mean(axis=0)
    a = path[:, :2] - middle
    b = onto[:, :2] - onto_middle
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    turned = se2.transform_points(se2.pose(0.0, 0.0, float(turn)), middle[None])[0]
    x, y = (onto_middle - turned).tolist()
    return se2.pose(x, y, float(turn))


def aligned_rms(path: Array, truth: Array) -> float:
    """Rms error of the positions of a path (N, 3), m, after the rigid motion that suits it best.

    The absolute trajectory error: what is left where the whole map may be turned and shifted.
    Source: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", 2012.
    """
    aligned = se2.transform_points(between_paths(path, truth), path[:, :2])
    return float(np.sqrt(np.square(aligned - truth[:, :2]).sum(axis=1).mean()))
