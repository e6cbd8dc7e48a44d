"""Loops over the beams of the scans of a view."""

import math

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import kernel


@kernel
def passed_cells(
    poses: Array, ranges: Array, bearings: Array, cell_m: float, half: int
) -> NDArray[np.bool_]:
    """Which cells of a lattice (2 half, 2 half) around the origin the beams of scans pass.

    poses (K, 3): of the lasers; ranges (K, B): as far as the beams are free, m, NaN for none;
    bearings (K, B): rad, frame of the laser.
    """
    passed = np.zeros((2 * half, 2 * half), dtype=np.bool_)
    for k in range(len(poses)):
        for i in range(ranges.shape[1]):
            if not ranges[k, i] > 0.0:
                continue
            angle = poses[k, 2] + bearings[k, i]
            dx = math.cos(angle)
            dy = math.sin(angle)
            x = poses[k, 0] / cell_m
            y = poses[k, 1] / cell_m
            for n in range(int(ranges[k, i] / cell_m) + 1):
                row = int(math.floor(y + n * dy)) + half
                col = int(math.floor(x + n * dx)) + half
                if row < 0 or col < 0 or row >= 2 * half or col >= 2 * half:
                    break
                passed[row, col] = True
    return passed
