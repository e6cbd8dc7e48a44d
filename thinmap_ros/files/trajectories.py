"""Trajectories in TUM format: `t x y z qx qy qz qw`, seconds and metres."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.files.safe import path_of, read_text, write_text


class StampedPoses(NamedTuple):
    """A trajectory: poses (N, 3), x and y in m and heading in rad, at stamps (N,) in ns."""

    stamps_ns: NDArray[np.int64]
    poses: Array

    def __repr__(self) -> str:
        return f'StampedPoses({len(self.poses)} poses, {se2.path_length_m(self.poses):.1f} m)'


class ScanTrajectory(NamedTuple):
    """The pose of each scan: live, as it was estimated then, and final, after all corrections."""

    live: StampedPoses
    final: StampedPoses


def write_trajectory(path: Path | str, trajectory: StampedPoses) -> None:
    """Write a trajectory, such as `slam.trajectory.final`, in TUM format.

    Raises InputError where it is none, and OSError.
    """
    stamps_ns, poses = stamped_poses('trajectory', trajectory)
    write_tum(path_of(path), stamps_ns.tolist(), list(poses))


def stamped_poses(what: str, value: Any) -> StampedPoses:
    """A trajectory of a caller. Raises InputError for anything else; what: the value's name."""
    try:
        stamps_ns, poses = value
        found = StampedPoses(np.asarray(stamps_ns, np.int64), np.asarray(poses, np.float64))
    except (TypeError, ValueError, OverflowError):
        found = StampedPoses(np.empty(0, np.int64), np.empty(0))
    if found.poses.shape != (*found.stamps_ns.shape, 3) or not np.isfinite(found.poses).all():
        raise InputError(
            f'{what} = {quoted(value)}: expected stamps (N,) in ns and poses (N, 3), as in '
            'slam.trajectory.final'
        )
    return found


def write_tum(path: Path, stamps_ns: Sequence[int], poses: Sequence[Array]) -> None:
    """Write one line per pose (3,); stamps are exact to the nanosecond."""
    lines = []
    for ns, (x, y, theta) in zip(stamps_ns, poses, strict=True):
        half = theta / 2.0
        lines.append(
            f'{ns // SECOND_NS}.{ns % SECOND_NS:09d} {x:.6f} {y:.6f} 0 0 0 '
            f'{math.sin(half):.9f} {math.cos(half):.9f}\n'
        )
    write_text(path, ''.join(lines))


def read_tum(path: Path) -> tuple[list[int], Array]:
    """Stamps in ns and poses (N, 3). Raises InputError naming file and line."""
    stamps = []
    poses = []
    for number, line in enumerate(read_text(path).split('\n'), start=1):
        fields = line.split('#', 1)[0].split()
        if not fields:
            continue
        try:
            seconds, _, nano = fields[0].partition('.')
            stamp_ns = int(seconds) * SECOND_NS + int(f'{nano:0<9.9}')
            x, y, _, _, _, qz, qw = (float(v) for v in fields[1:])
        except ValueError as error:
            text = quoted(line[:60])
            raise InputError(f'{path}:{number}: {text}: expected t x y z qx qy qz qw') from error
        if not all(map(math.isfinite, (x, y, qz, qw))):
            raise InputError(f'{path}:{number}: {quoted(line[:60])}: expected finite numbers')
        stamps.append(stamp_ns)
        poses.append(se2.pose(x, y, 2.0 * math.atan2(qz, qw)))
    return stamps, np.array(poses).reshape(-1, 3)
