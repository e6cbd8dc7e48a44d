"""Errors of a run, in memory or in files, against a reference."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thinmap_ros.core.errors import InputError, quoted, require_type, with_known_keywords
from thinmap_ros.evaluation.trajectory_errors import (
    MAX_TIME_DIFFERENCE_S,
    Comparison,
    compare_with_relations,
    compare_with_trajectory,
)
from thinmap_ros.files.safe import path_of
from thinmap_ros.files.trajectories import (
    ScanTrajectory,
    StampedPoses,
    read_tum,
    stamped_poses,
)
from thinmap_ros.pipeline import Pipeline

# Of a folder of replay: live poses, and the same after all corrections.
_FILES = ('trajectory.tum', 'trajectory_final.tum')
_RELATIONS = 'relations'


@dataclass(frozen=True)
class _Named:
    """A trajectory, or a reference, with its name in messages."""

    name: str
    trajectory: StampedPoses


@with_known_keywords
def evaluate(
    run: object,
    reference: object,
    *,
    align: bool = False,
    max_difference_s: float = MAX_TIME_DIFFERENCE_S,
    delta: int = 1,
) -> dict[str, Comparison]:
    """Absolute and relative pose errors of a run against a reference, as `thinmap evaluate`.

    run: a Pipeline or its trajectory, of which live and final poses are compared, StampedPoses, or
    a folder of replay or FILE.tum, whose trajectories are compared by the names of their files.
    reference: StampedPoses, FILE.tum, or a file of relations `t1 t2 x y z roll pitch yaw`. align:
    moves the run onto the reference first, by least squares of positions. max_difference_s: largest
    time between a pose and that of the reference, s. delta: poses between those of a relative
    error. Raises InputError where a file is invalid or too few stamps are common.
    Source: Grupp, "evo: Python package for the evaluation of odometry and SLAM", 2017.
    """
    require_type('max_difference_s', max_difference_s, float, int)
    require_type('delta', delta, int)
    if not max_difference_s >= 0.0 or delta < 1:
        given = f'time difference {max_difference_s:g} s, delta {delta}'
        raise InputError(f'{given}: expected no negative time, and at least 1 pose')
    trajectories = _trajectories(run)
    path = path_of(reference) if isinstance(reference, str | Path) else None
    if path is not None and (path.name == _RELATIONS or path.suffix == f'.{_RELATIONS}'):
        return {
            key: compare_with_relations(known.trajectory, known.name, path, max_difference_s)
            for key, known in trajectories.items()
        }
    if path is not None and path.suffix != '.tum':
        raise InputError(f'{path}: expected a name that ends in .tum or {_RELATIONS}')
    if path is None:
        truth = _Named('the reference', stamped_poses('reference', reference))
    else:
        truth = _read(path)
    return {
        key: compare_with_trajectory(
            known.trajectory,
            truth.trajectory,
            (known.name, truth.name),
            align,
            max_difference_s,
            delta,
        )
        for key, known in trajectories.items()
    }


def _trajectories(run: object) -> dict[str, _Named]:
    if isinstance(run, str | Path):
        return {path.name: _read(path) for path in trajectory_files(Path(run))}
    known = run.trajectory if isinstance(run, Pipeline) else run
    if isinstance(known, ScanTrajectory):
        return {name: _Named(name, poses) for name, poses in known._asdict().items()}
    if not isinstance(known, tuple):
        raise InputError(
            f'run = {quoted(run)}: expected a Pipeline, StampedPoses, a folder of replay, or '
            'FILE.tum'
        )
    return {'run': _Named('run', stamped_poses('run', known))}


def trajectory_files(run: Path) -> list[Path]:
    """Files of the trajectories of a run: of its folder, or itself. Raises InputError: none."""
    if not run.is_dir():
        return [run]
    found = [run / name for name in _FILES if (run / name).exists()]
    if not found:
        raise InputError(f'{run}: no {" and no ".join(_FILES)}: expected one of them')
    return found


def _read(path: Path) -> _Named:
    stamps_ns, poses = read_tum(path)
    return _Named(str(path), StampedPoses(np.array(stamps_ns, dtype=np.int64), poses))
