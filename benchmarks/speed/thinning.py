"""Thinning against scikit-image, OpenCV, a mask's copy and a distance transform, in one run."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.morphology import skeletonize

from benchmarks.rows import Row, at_least, at_most
from benchmarks.time_and_memory import best_seconds
from benchmarks.worlds import floors
from thinmap_ros.core.topology.thinning import thin

Mask = NDArray[np.bool_]
_FASTER = {400: (20.0, 40.0), 1000: (50.0, 100.0), 4000: (50.0, 100.0)}


def floor_of(worlds: Path, side: int) -> Mask:
    """Free cells of a real floor, laid side by side until the size is reached."""
    free = floors(worlds, 'kth/50052749')[0].world.occupied == 0
    rows, cols = free.shape
    return np.ascontiguousarray(np.tile(free, (-(-side // rows), -(-side // cols)))[:side, :side])


def padded_opencv(free: Mask) -> Mask:
    """Zhang-Suen by OpenCV, padded because it leaves the outermost cells alone."""
    padded = np.pad(free, 1).astype(np.uint8) * 255
    return np.asarray(
        cv2.ximgproc.thinning(padded, thinningType=cv2.ximgproc.THINNING_ZHANGSUEN)[1:-1, 1:-1] > 0
    )


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows for each size."""
    cv2.setNumThreads(1)
    for side in (400, 1000) if quick else (400, 1000, 4000):
        free = floor_of(worlds, side)
        assert np.array_equal(thin(free), padded_opencv(free)), 'thinning is not that of the paper'
        grey = free.astype(np.uint8)
        fast = best_seconds(
            {
                'thin': partial(thin, free),
                'copy': free.copy,
                'distance': partial(cv2.distanceTransform, grey, cv2.DIST_L2, 5),
            },
            rounds=30 if side <= 1000 else 5,
        )
        slow = best_seconds(
            {
                'skimage': partial(skeletonize, free),
                'opencv': partial(padded_opencv, free),
            },
            rounds=3 if side <= 1000 else 1,
        )
        yield Row(f'{side} x {side} cells', f'{1e3 * fast["thin"]:.2f} ms')
        for name, limit in zip(('skimage', 'opencv'), _FASTER[side], strict=True):
            yield at_least(f'  times faster than {name}', slow[name] / fast['thin'], limit)
        if side == 1000:
            yield at_most('  time / copy of the mask', fast['thin'] / fast['copy'], 60.0)
            yield at_most(
                '  time / distance transform (L2, 5)', fast['thin'] / fast['distance'], 0.5
            )
