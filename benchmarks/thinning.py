"""Thinning against scikit-image, OpenCV, a copy of the mask and a distance transform, in one run."""

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.morphology import skeletonize

from benchmarks.table import Row, at_least, at_most
from benchmarks.timing import best_seconds
from thinmap_ros.core.topology.thinning import thin

Mask = NDArray[np.bool_]
_FASTER = {400: (20.0, 40.0), 1000: (50.0, 100.0), 4000: (50.0, 100.0)}


def floor_like(side: int, seed: int = 0) -> Mask:
    """Free space of a made-up building: rooms of 3 to 12 m with doors, 10 cm a cell, and bumps on the walls."""
    rng = np.random.default_rng(seed)
    free = np.ones((side, side), dtype=np.bool_)
    for axis in (0, 1):
        at = 0
        while at < side:
            wall = free[at : at + 3] if axis == 0 else free[:, at : at + 3].T
            wall[:] = False
            for door in rng.integers(0, side, max(side // 60, 1)):
                wall[:, door : door + 10] = True
            at += int(rng.integers(30, 120))
    free &= rng.random((side, side)) > 0.0005
    free[:1], free[-1:], free[:, :1], free[:, -1:] = False, False, False, False
    return free


def padded_opencv(free: Mask) -> Mask:
    """Zhang-Suen by OpenCV, padded because it leaves the outermost cells alone."""
    padded = np.pad(free, 1).astype(np.uint8) * 255
    return np.asarray(cv2.ximgproc.thinning(padded, thinningType=cv2.ximgproc.THINNING_ZHANGSUEN)[1:-1, 1:-1] > 0)


def run(quick: bool) -> list[Row]:
    """Rows for each size."""
    rows = []
    cv2.setNumThreads(1)
    for side in (400, 1000) if quick else (400, 1000, 4000):
        free = floor_like(side)
        assert np.array_equal(thin(free), padded_opencv(free)), 'thinning is not that of the paper'
        grey = free.astype(np.uint8)
        fast = best_seconds(
            {
                'thin': lambda free=free: thin(free),
                'copy': lambda free=free: free.copy(),
                'distance': lambda grey=grey: cv2.distanceTransform(grey, cv2.DIST_L2, 5),
            },
            rounds=30 if side <= 1000 else 5,
        )
        slow = best_seconds(
            {'skimage': lambda free=free: skeletonize(free), 'opencv': lambda free=free: padded_opencv(free)},
            rounds=3 if side <= 1000 else 1,
        )
        rows.append(Row(f'thin {side} x {side}', f'{1e3 * fast["thin"]:.2f} ms'))
        for name, limit in zip(('skimage', 'opencv'), _FASTER[side], strict=True):
            rows.append(at_least(f'  times faster than {name}', slow[name] / fast['thin'], limit))
        if side == 1000:
            rows.append(at_most('  in copies of the mask', fast['thin'] / fast['copy'], 60.0))
            rows.append(at_most('  in distance transforms (L2, 5)', fast['thin'] / fast['distance'], 0.5))
    return rows
