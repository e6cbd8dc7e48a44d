"""Planar poses [x m, y m, theta rad] as float64 arrays.

T_a_b is the pose of frame b seen from frame a.
"""

import math
from typing import overload

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Larger coordinates are errors. Beyond 1e15 m, float64 cannot even resolve cells, and computed
# indices lie outside of every array.
MAX_COORDINATE_M = 1e6


@overload
def wrap(angle: float) -> float: ...
@overload
def wrap(angle: Array) -> Array: ...
def wrap(angle: float | Array) -> float | Array:
    """Angle(s) wrapped to (-pi, pi], rad."""
    if isinstance(angle, np.ndarray):
        return np.pi - np.mod(np.pi - angle, 2.0 * np.pi)
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


def pose(x: float, y: float, theta: float) -> Array:
    """Pose array (3,) with its heading wrapped."""
    return np.array([x, y, wrap(float(theta))])


def compose(T_a_b: Array, T_b_c: Array) -> Array:
    """Pose of c in a: T_a_b o T_b_c, (3,)."""
    # Python's own numbers: one at a time they are much faster than elements of arrays.
    x, y, theta = T_a_b.tolist()
    dx, dy, turn = T_b_c.tolist()
    c = math.cos(theta)
    s = math.sin(theta)
    return pose(x + c * dx - s * dy, y + s * dx + c * dy, theta + turn)


def invert(T_a_b: Array) -> Array:
    """Pose of a in b, (3,)."""
    c = math.cos(T_a_b[2])
    s = math.sin(T_a_b[2])
    return pose(-c * T_a_b[0] - s * T_a_b[1], s * T_a_b[0] - c * T_a_b[1], -T_a_b[2])


def between(T_a_b: Array, T_a_c: Array) -> Array:
    """Pose of c in b, both given in a: invert(T_a_b) o T_a_c, (3,)."""
    return compose(invert(T_a_b), T_a_c)


def pose_difference(T: Array, T_expected: Array) -> Array:
    """Difference T - T_expected in x, y and heading (wrapped), (3,)."""
    x, y, theta = (T - T_expected).tolist()
    return np.array([x, y, wrap(theta)])


def transform_points(T_a_b: Array, points_b: Array) -> Array:
    """Points (N, 2) given in b, expressed in a, (N, 2)."""
    c = math.cos(T_a_b[2])
    s = math.sin(T_a_b[2])
    return np.asarray(points_b @ np.array([[c, s], [-s, c]]) + T_a_b[:2])


def interpolate(T_a: Array, T_b: Array, share: float) -> Array:
    """Pose on the straight line from T_a (share 0) to T_b (share 1); the shorter rotation."""
    x, y = T_a[:2] + share * (T_b[:2] - T_a[:2])
    return pose(x, y, T_a[2] + share * wrap(float(T_b[2] - T_a[2])))


def is_bounded_pose(T: Array) -> bool:
    """Whether a pose (3,) is finite, with |x| and |y| at most MAX_COORDINATE_M."""
    return is_finite(T) and abs(T[0]) <= MAX_COORDINATE_M and abs(T[1]) <= MAX_COORDINATE_M


def is_finite(T: Array) -> bool:
    """Whether all three numbers of a pose are finite."""
    return bool(np.isfinite(T).all())
