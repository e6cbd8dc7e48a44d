"""Trajectories in TUM format: `t x y z qx qy qz qw`, seconds and metres."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.files.safe import read_text, write_text


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
