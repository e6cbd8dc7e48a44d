"""Covariances (3, 3) of planar poses: rotated, and carried to a pose at a fixed offset."""

import math

import numpy as np

from thinmap_ros.core.se2 import Array

BOUND_SIGMAS = 3.0  # an error of more standard deviations than this is not noise


def rotation(theta: float) -> Array:
    """Matrix R (3, 3) that rotates increments by theta, and covariances C by R C R'."""
    c = math.cos(theta)
    s = math.sin(theta)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotated_covariance(covariance: Array, theta: float) -> Array:
    """Covariance (3, 3) of a relative pose, rotated by theta into the map frame."""
    R = rotation(theta)
    return np.asarray(R @ covariance @ R.T)


def propagated_covariance(covariance: Array, lever: Array) -> Array:
    """Covariance (3, 3) of a pose at a fixed offset from a pose of that covariance, map frame.

    lever (2,): offset, m. Source: Smith, Self and Cheeseman, "Estimating uncertain spatial
    relationships in robotics", 1990, compounding.
    """
    F = _compounding(lever)
    return np.asarray(F @ covariance @ F.T)


def carried(derivative: Array, lever: Array) -> Array:
    """Derivative (3, 4) of a pose at a fixed offset (2,), m, from a pose with that derivative."""
    return np.asarray(_compounding(lever) @ derivative)


def inverse(matrix: Array) -> Array:
    """Information (3, 3) of a covariance, and vice versa."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _compounding(lever: Array) -> Array:
    return np.array([[1.0, 0.0, -lever[1]], [0.0, 1.0, lever[0]], [0.0, 0.0, 1.0]])
