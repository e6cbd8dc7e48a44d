"""Trajectory errors: by known relations between poses, or after alignment with the truth."""

from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import SECOND_NS, Array, wrap
from thinmap_ros.files.safe import read_text
from thinmap_ros.files.trajectories import StampedPoses


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
    """Errors of the evaluated relations, and their first stamps: m, degrees, and s, (N,) each."""

    metres: Array
    degrees: Array
    times_s: Array


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
    return RelationErrors(np.array(metres), np.array(degrees), known[:, 0])


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
    stamps_s = []
    for t1, t2, *motion in known:
        a, b = (_nearest(times, t) for t in (t1, t2))
        if max(abs(times[a] - t1), abs(times[b] - t2)) <= near_s:
            off.append(se2.between(np.array(motion), se2.between(path[a], path[b])))
            stamps_s.append(t1)
    errors = np.array(off).reshape(-1, 3)
    return RelationErrors(*_metres_and_degrees(errors), np.array(stamps_s))


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


MIN_POSES = 3
MAX_TIME_DIFFERENCE_S = 0.01  # as evo's --t_max_diff


@dataclass(frozen=True)
class Statistics:
    """Statistics of errors, as evo prints them; sse: sum of squares."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    sse: float

    @staticmethod
    def of(errors: Array) -> 'Statistics':
        """Statistics of errors (N,)."""
        squares = np.square(errors)
        return Statistics(
            float(np.sqrt(squares.mean())),
            float(errors.mean()),
            float(np.median(errors)),
            float(errors.std()),
            float(errors.min()),
            float(errors.max()),
            float(squares.sum()),
        )


@dataclass(frozen=True, eq=False)
class Comparison:
    """Errors of a trajectory by what they are of; poses: number of compared poses or relations.

    curves: of the same errors, (N, 2): stamp, s, and error, in the order of the stamps.
    """

    poses: int
    curves: dict[str, Array] = field(repr=False)

    @property
    def errors(self) -> dict[str, Statistics]:
        """Statistics of the errors."""
        return {name: Statistics.of(curve[:, 1]) for name, curve in self.curves.items()}

    def __repr__(self) -> str:
        rows = []
        for name, of in self.errors.items():
            numbers = '  '.join(f'{key} {value:.6f}' for key, value in asdict(of).items())
            rows.append(f'  {name:14} {numbers}')
        return '\n'.join(rows)

    def as_dict(self) -> dict[str, Any]:
        """Numbers by name, for JSON."""
        return {'poses': self.poses, **{name: asdict(of) for name, of in self.errors.items()}}


def compare_with_trajectory(
    trajectory: StampedPoses,
    reference: StampedPoses,
    names: tuple[str, str],
    is_aligned: bool,
    max_difference_s: float,
    delta: int,
) -> Comparison:
    """Absolute and relative pose errors of a trajectory against another one, as evo has them.

    names: of both, for messages. is_aligned: whether the trajectory is moved onto the reference
    first (evo's --align), which does not change relative errors. delta: poses between the two of a
    relative error. Raises InputError where fewer than three stamps are common.
    Source: Grupp, "evo: Python package for the evaluation of odometry and SLAM", 2017.
    """
    own, other = associated(
        trajectory.stamps_ns, reference.stamps_ns, round(max_difference_s * SECOND_NS)
    )
    if len(own) < MIN_POSES or len(own) <= delta:
        raise InputError(
            f'{names[0]}: {len(own)} stamps within {max_difference_s:g} s of those of {names[1]}: '
            f'expected at least {max(MIN_POSES, delta + 1)}'
        )
    estimate = trajectory.poses[own]
    expected = reference.poses[other]
    T = between_paths(estimate, expected) if is_aligned else np.zeros(3)
    absolute = _differences(np.array([se2.compose(T, pose) for pose in estimate]), expected)
    relative = _differences(_motions(estimate, delta), _motions(expected, delta))
    times_s = trajectory.stamps_ns[own] / SECOND_NS
    return Comparison(
        len(own),
        _curves('APE', times_s, *_metres_and_degrees(absolute))
        | _curves('RPE', times_s[::delta][1:], *_metres_and_degrees(relative)),
    )


def compare_with_relations(
    trajectory: StampedPoses, name: str, relations: Path, max_difference_s: float
) -> Comparison:
    """Errors of a trajectory by a file of relations `t1 t2 x y z roll pitch yaw` between poses.

    name: of the trajectory, for messages. A relation counts where both of its stamps have a pose
    within max_difference_s. Raises InputError where the file is invalid, or no relation counts.
    """
    times_s = trajectory.stamps_ns / SECOND_NS
    errors = known_relation_errors(times_s, trajectory.poses, relations, max_difference_s)
    if not len(errors.metres):
        raise InputError(
            f'{relations}: no relation whose stamps are within {max_difference_s:g} s of poses of '
            f'{name}'
        )
    curves = _curves('relations', errors.times_s, errors.metres, errors.degrees)
    return Comparison(len(errors.metres), curves)


def _curves(of: str, times_s: Array, metres: Array, degrees: Array) -> dict[str, Array]:
    order = np.argsort(times_s, kind='stable')
    named = {f'{of}, m': metres, f'{of}, deg': degrees}
    return {name: np.column_stack([times_s, errors])[order] for name, errors in named.items()}


def _metres_and_degrees(differences: Array) -> tuple[Array, Array]:
    """Lengths and absolute angles (N,) of differences of poses (N, 3)."""
    return np.hypot(*differences[:, :2].T), np.degrees(np.abs(differences[:, 2]))


def associated(
    stamps_ns: NDArray[np.int64], known_ns: NDArray[np.int64], max_difference_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices (K,) of the stamps, and of the known ones nearest to them, in order of time.

    As evo does, each stamp of the shorter list has its nearest of the longer one, if that is near
    enough.
    """
    if len(stamps_ns) > len(known_ns):
        other, own = associated(known_ns, stamps_ns, max_difference_ns)
        return own, other
    if not len(stamps_ns):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    order = np.argsort(known_ns, kind='stable')
    ordered = known_ns[order]
    after = np.clip(np.searchsorted(ordered, stamps_ns), 0, len(ordered) - 1)
    before = np.maximum(after - 1, 0)
    is_before = np.abs(ordered[before] - stamps_ns) <= np.abs(ordered[after] - stamps_ns)
    nearest = np.where(is_before, before, after)
    own = np.flatnonzero(np.abs(ordered[nearest] - stamps_ns) <= max_difference_ns)
    return own, order[nearest[own]]


def _motions(poses: Array, delta: int) -> Array:
    """Motions (K, 3) from each delta-th pose (N, 3) to the next of them."""
    chosen = poses[::delta]
    return np.array([se2.between(a, b) for a, b in pairwise(chosen)])


def _differences(poses: Array, expected: Array) -> Array:
    """Poses (N, 3) in the frames of the expected ones."""
    return np.array([se2.between(b, a) for a, b in zip(poses, expected, strict=True)])
