"""Planar poses [x m, y m, theta rad] as float64 arrays, their covariances, points and stamps.

T_a_b is the pose of frame b seen from frame a.
"""

import math
from collections.abc import Sequence
from typing import overload

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Cell = tuple[int, int]  # row and column
Cells = NDArray[np.int64]  # rows and columns (N, 2), or numbers (N,)
Mask = NDArray[np.bool_]  # which cells (H, W), or which of some things (N,)
Place = tuple[float, float]  # x and y, m

# Larger coordinates are errors. Beyond 1e15 m, float64 cannot even resolve cells, and computed
# indices lie outside of every array.
MAX_COORDINATE_M = 1e6
_TURN = 2.0 * math.pi
BOUND_SIGMAS = 3.0  # an error of more standard deviations than this is not noise

# Stamps are nanoseconds since 1970. Messages of ROS hold the seconds in 32 bits with a sign.
SECOND_NS = 1_000_000_000
CLOCK_JUMP_NS = SECOND_NS  # a clock that steps back by more was set back
LATEST_S = 2**31  # in 2038
LATEST_NS = LATEST_S * SECOND_NS


@overload
def wrap(angle: float) -> float: ...


@overload
def wrap(angle: Array) -> Array: ...


def wrap(angle: float | Array) -> float | Array:
    """Angle(s) wrapped to (-pi, pi], rad."""
    if isinstance(angle, np.ndarray):
        return np.pi - np.mod(np.pi - angle, _TURN)
    return math.pi - (math.pi - angle) % _TURN


def path_length_m(path: Array) -> float:
    """Length of a path of points (N, 2) or poses (N, 3), m."""
    return float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum())


def pose(x: float, y: float, theta: float) -> Array:
    """Pose array (3,) with its heading wrapped."""
    return np.array([x, y, wrap(float(theta))])


def compose(T_a_b: Array, T_b_c: Array) -> Array:
    """Pose of c in a: T_a_b o T_b_c, (3,)."""
    # Python's own numbers: one at a time they are much faster than elements of arrays.
    # For the same reason the heading is wrapped here: some sixty poses are composed for each scan.
    x, y, theta = T_a_b.tolist()
    dx, dy, turn = T_b_c.tolist()
    c = math.cos(theta)
    s = math.sin(theta)
    heading = math.pi - (math.pi - (theta + turn)) % _TURN
    return np.array([x + c * dx - s * dy, y + s * dx + c * dy, heading])


def invert(T_a_b: Array) -> Array:
    """Pose of a in b, (3,)."""
    x, y, theta = T_a_b.tolist()
    c = math.cos(theta)
    s = math.sin(theta)
    return np.array([-c * x - s * y, s * x - c * y, math.pi - (math.pi + theta) % _TURN])


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


def transform_each(poses: Array, points: Array) -> Array:
    """Points (N, 2), each by a pose of its own (N, 3)."""
    c = np.cos(poses[:, 2])
    s = np.sin(poses[:, 2])
    x = poses[:, 0] + c * points[:, 0] - s * points[:, 1]
    y = poses[:, 1] + s * points[:, 0] + c * points[:, 1]
    return np.column_stack([x, y])


def compose_each(poses: Array, others: Array) -> Array:
    """Poses (N, 3) of frames given in frames of their own, (N, 3) or (1, 3), by those (N, 3)."""
    xy = transform_each(poses, others[:, :2])
    return np.column_stack([xy, wrap(poses[:, 2] + others[:, 2])])


def interpolate(T_a: Array, T_b: Array, share: float) -> Array:
    """Pose on the straight line from T_a (share 0) to T_b (share 1); the shorter rotation."""
    x, y = T_a[:2] + share * (T_b[:2] - T_a[:2])
    return pose(x, y, T_a[2] + share * wrap(float(T_b[2] - T_a[2])))


def are_apart(T_a: Array, T_b: Array, metres: float, radians: float) -> bool:
    """Whether two poses (3,) are more than a distance or an angle apart."""
    x, y, turn = between(T_a, T_b).tolist()
    return math.hypot(x, y) > metres or abs(turn) > radians


def distinct(poses: Array, apart_m: float, apart_rad: float, most: int) -> list[int]:
    """Indices of the poses (N, 3) that are apart from all before them, at most so many.

    In x or in y, or in their heading.
    """
    kept: list[int] = []
    at = np.empty((most, 3))
    for k, T in enumerate(poses):
        off = np.abs(at[: len(kept)] - T)
        near = (off[:, 0] <= apart_m) & (off[:, 1] <= apart_m)
        if not (np.abs(wrap(off[near, 2])) <= apart_rad).any():
            at[len(kept)] = T
            kept.append(k)
            if len(kept) == most:
                break
    return kept


def bearing(a: Sequence[float] | Array, b: Sequence[float] | Array) -> float:
    """Direction of a point (x, y, ...) seen from another, rad."""
    return math.atan2(b[1] - a[1], b[0] - a[0])


def lengths_along(points: Array) -> Array:
    """Length of a line through points (N, 2) from its start to each of them, (N,)."""
    return np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))


def path_length(points: Array) -> float:
    """Length of a line through points (N, 2)."""
    return float(np.hypot(*np.diff(points, axis=0).T).sum())


def distances_from_line(points: Array) -> Array:
    """Distance (N,) of points (N, 2) from the line through the first and the last of them."""
    line = points[-1] - points[0]
    off = points - points[0]
    length = max(float(np.hypot(*line)), 1e-9)
    return np.asarray(np.abs(off[:, 0] * line[1] - off[:, 1] * line[0]) / length)


def is_bounded_pose(T: Array) -> bool:
    """Whether a pose (3,) is finite, with |x| and |y| at most MAX_COORDINATE_M."""
    return is_finite(T) and abs(T[0]) <= MAX_COORDINATE_M and abs(T[1]) <= MAX_COORDINATE_M


def is_finite(T: Array) -> bool:
    """Whether all three numbers of a pose are finite."""
    return bool(np.isfinite(T).all())


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


def variances(covariance: Array) -> tuple[float, float]:
    """Variances of a covariance (2, 2) in its most and its least certain direction."""
    (xx, xy), (_, yy) = covariance.tolist()
    middle = 0.5 * (xx + yy)
    apart = math.hypot(0.5 * (xx - yy), xy)
    return middle - apart, middle + apart


def sigma_m(covariance: Array) -> float:
    """Standard deviation, m, of a position with a covariance (3, 3), where it is least certain."""
    return math.sqrt(max(variances(covariance[:2, :2])[1], 0.0))


def inverse(matrix: Array) -> Array:
    """Information (3, 3) of a covariance, and vice versa."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _compounding(lever: Array) -> Array:
    return np.array([[1.0, 0.0, -lever[1]], [0.0, 1.0, lever[0]], [0.0, 0.0, 1.0]])
