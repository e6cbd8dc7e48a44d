"""Trajectory errors: by known relations between poses, or after alignment with the truth."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array, wrap
from thinmap_ros.files.safe import read_text


def between_paths(path: Array, onto: Array) -> Array:
    """Rigid motion (3,) that aligns a path (N, 3) with another, by least squares of positions."""
    middle = path[:, :2].mean(axis=0)
    onto_middle = onto[:, :2].mean(axis=0)
    a = path[:, :2] - middle
    b = onto[:, :2] - onto_middle
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    turned = se2.transform_points(se2.pose(0.0, 0.0, float(turn)), middle[None])[0]
    x, y = (onto_middle - turned).tolist()
    return se2.pose(x, y, float(turn))


def aligned_rms(path: Array, truth: Array) -> float:
    """Absolute trajectory error: rms error of positions (N, 3), m, after rigid alignment.

    Source: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", 2012.
    """
    aligned = se2.transform_points(between_paths(path, truth), path[:, :2])
    return float(np.sqrt(np.square(aligned - truth[:, :2]).sum(axis=1).mean()))


@dataclass(frozen=True, eq=False)
class RelationErrors:
    """Errors of the evaluated relations: m and degrees, (N,) each."""

    metres: Array
    degrees: Array


def read_columns(path: Path, columns: list[int]) -> Array:
    """Some columns (N, len(columns)) of a text of numbers.

    Raises InputError if a line lacks these numbers.
    """
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split('#')[0].split()
        if words:
            try:
                rows.append([float(words[k]) for k in columns])
            except (ValueError, IndexError):
                raise InputError(
                    f'{path}: line {number}: expected numbers in {max(columns) + 1} columns'
                ) from None
    return np.array(rows, dtype=np.float64).reshape(-1, len(columns))


def relation_errors(
    times_s: Array, poses: Array, relations: Path, odometry: Path, near_s: float = 0.1
) -> RelationErrors:
    """Errors of poses (N, 3) at times (N,), s, by a file of relations `t1 t2 x y z roll pitch yaw`.

    For each relation, the difference of the true motion between two stamps and the estimated one.
    odometry: a file of `t x y theta`; it extrapolates poses that are farther than near_s from a
    stamp.
    Source: Kuemmerle et al., "On measuring the accuracy of SLAM algorithms", 2009.
    """
    known = read_columns(relations, [0, 1, 2, 3, 7])
    wheels = read_columns(odometry, [0, 1, 2, 3])
    order = np.argsort(times_s, kind='stable')
    wheel_order = np.argsort(wheels[:, 0], kind='stable')
    times = times_s[order]
    path = poses[order]
    wheels = wheels[wheel_order]
    metres = []
    degrees = []
    for t1, t2, *motion in known:
        a, b = (_pose_at(t, times, path, wheels, near_s) for t in (t1, t2))
        off = se2.between(np.array(motion), se2.between(a, b))
        metres.append(float(np.hypot(off[0], off[1])))
        degrees.append(float(np.degrees(abs(wrap(float(off[2]))))))
    return RelationErrors(np.array(metres), np.array(degrees))


def known_relation_errors(
    times_s: Array, poses: Array, relations: Path, near_s: float
) -> RelationErrors:
    """Errors of poses (N, 3) at times (N,), s, by those relations whose stamps have a pose.

    near_s: how far a pose may be from a stamp, s. Source: as `relation_errors`.
    """
    known = read_columns(relations, [0, 1, 2, 3, 7])
    order = np.argsort(times_s, kind='stable')
    times = times_s[order]
    path = poses[order]
    off = []
    for t1, t2, *motion in known:
        a, b = (_nearest(times, t) for t in (t1, t2))
        if max(abs(times[a] - t1), abs(times[b] - t2)) <= near_s:
            off.append(se2.between(np.array(motion), se2.between(path[a], path[b])))
    errors = np.array(off).reshape(-1, 3)
    return RelationErrors(np.hypot(errors[:, 0], errors[:, 1]), np.degrees(np.abs(errors[:, 2])))


def _pose_at(t: float, times: Array, path: Array, wheels: Array, near_s: float) -> Array:
    k = _nearest(times, t)
    if abs(times[k] - t) <= near_s:
        return np.asarray(path[k])
    moved = se2.between(
        wheels[_nearest(wheels[:, 0], times[k]), 1:], wheels[_nearest(wheels[:, 0], t), 1:]
    )
    return se2.compose(path[k], moved)


def _nearest(times: Array, t: float) -> int:
    k = int(np.searchsorted(times, t))
    return min(
        (j for j in (k - 1, k) if 0 <= j < len(times)), key=lambda j: abs(float(times[j]) - t)
    )
