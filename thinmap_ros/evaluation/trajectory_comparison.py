"""Errors of a trajectory against a reference, with the conventions of evo.

Source: Grupp, "evo: Python package for the evaluation of odometry and SLAM", 2017.
"""

from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.evaluation.trajectory_errors import between_paths, known_relation_errors
from thinmap_ros.files.trajectories import read_tum

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


@dataclass(frozen=True)
class Comparison:
    """Errors of a trajectory by what they are of; poses: number of compared poses or relations."""

    poses: int
    errors: dict[str, Statistics]

    def as_dict(self) -> dict[str, Any]:
        """Numbers by name, for JSON."""
        return {'poses': self.poses, **{name: asdict(of) for name, of in self.errors.items()}}


def compare_with_tum(
    path: Path, reference: Path, is_aligned: bool, max_difference_s: float, delta: int
) -> Comparison:
    """Absolute and relative pose errors of a TUM trajectory against another one.

    is_aligned: whether the trajectory is moved onto the reference first (evo's --align), which
    does not change relative errors. delta: poses between the two of a relative error. Raises
    InputError where a file is invalid, or fewer than three stamps are common.
    """
    stamps_ns, poses = read_tum(path)
    known_ns, truth = read_tum(reference)
    own, other = associated(
        np.array(stamps_ns), np.array(known_ns), round(max_difference_s * SECOND_NS)
    )
    if len(own) < MIN_POSES or len(own) <= delta:
        raise InputError(
            f'{path}: {len(own)} stamps within {max_difference_s:g} s of those of {reference}: '
            f'expected at least {max(MIN_POSES, delta + 1)}'
        )
    estimate = poses[own]
    expected = truth[other]
    T = between_paths(estimate, expected) if is_aligned else np.zeros(3)
    absolute = _differences(np.array([se2.compose(T, pose) for pose in estimate]), expected)
    relative = _differences(_motions(estimate, delta), _motions(expected, delta))
    return Comparison(
        len(own),
        {
            'APE, m': Statistics.of(np.hypot(absolute[:, 0], absolute[:, 1])),
            'APE, deg': Statistics.of(np.degrees(np.abs(absolute[:, 2]))),
            'RPE, m': Statistics.of(np.hypot(relative[:, 0], relative[:, 1])),
            'RPE, deg': Statistics.of(np.degrees(np.abs(relative[:, 2]))),
        },
    )


def compare_with_relations(path: Path, relations: Path, max_difference_s: float) -> Comparison:
    """Errors of a TUM trajectory by known relations `t1 t2 x y z roll pitch yaw` between poses.

    A relation counts where both of its stamps have a pose within max_difference_s. Raises
    InputError where a file is invalid, or no relation counts.
    """
    stamps_ns, poses = read_tum(path)
    times_s = np.array(stamps_ns) / SECOND_NS
    errors = known_relation_errors(times_s, poses, relations, max_difference_s)
    if not len(errors.metres):
        raise InputError(
            f'{relations}: no relation whose stamps are within {max_difference_s:g} s of poses of '
            f'{path}'
        )
    return Comparison(
        len(errors.metres),
        {
            'relations, m': Statistics.of(errors.metres),
            'relations, deg': Statistics.of(errors.degrees),
        },
    )


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
