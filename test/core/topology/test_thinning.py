"""Thinning against a literal reading of the paper, and against OpenCV."""

import cv2
import numpy as np
import pytest
from drawings import world
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from thinmap_ros.core.topology.thinning import thin


def literal(free: np.ndarray) -> np.ndarray:
    """Steps 1 and 2 of the topological map paper, section 2.1, cell by cell."""
    cells = np.pad(free, 1).astype(int)
    while True:
        deleted = 0
        for step in (1, 2):
            doomed = []
            for row, col in np.argwhere(cells):
                p2 = cells[row - 1, col]
                p3 = cells[row - 1, col + 1]
                p4 = cells[row, col + 1]
                p5 = cells[row + 1, col + 1]
                p6 = cells[row + 1, col]
                p7 = cells[row + 1, col - 1]
                p8 = cells[row, col - 1]
                p9 = cells[row - 1, col - 1]
                ring = [p2, p3, p4, p5, p6, p7, p8, p9]
                rises = sum(a == 0 and b == 1 for a, b in zip(ring, [*ring[1:], p2], strict=True))
                first, second = (
                    (p2 * p4 * p6, p4 * p6 * p8) if step == 1 else (p2 * p4 * p8, p2 * p6 * p8)
                )
                if 2 <= sum(ring) <= 6 and rises == 1 and first == 0 and second == 0:
                    doomed.append((row, col))
            for row, col in doomed:
                cells[row, col] = 0
            deleted += len(doomed)
        if not deleted:
            return cells[1:-1, 1:-1].astype(bool)


def opencv(free: np.ndarray) -> np.ndarray:
    padded = np.pad(free, 1).astype(np.uint8) * 255
    return (
        cv2.ximgproc.thinning(padded, thinningType=cv2.ximgproc.THINNING_ZHANGSUEN)[1:-1, 1:-1] > 0
    )


masks = arrays(np.bool_, array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=24))


@given(masks)
@settings(max_examples=60)
def test_equals_the_paper_on_any_mask(free):
    before = free.copy()
    result = thin(free)
    assert np.array_equal(result, literal(free))
    assert np.array_equal(free, before), 'input untouched'
    assert not (result & ~free).any(), 'no cell added'


@given(st.integers(0, 10_000))
@settings(max_examples=60)
def test_equals_opencv_across_words(seed):
    rng = np.random.default_rng(seed)
    rows, cols = rng.integers(1, 300, 2)
    noise = cv2.blur(rng.random((rows, cols)).astype(np.float32), (5, 5))
    free = noise > np.quantile(noise, rng.uniform(0.1, 0.9))
    assert np.array_equal(thin(free), opencv(free))


@pytest.mark.parametrize('cols', [1, 63, 64, 65, 127, 128, 129])
def test_equals_opencv_at_the_borders_of_words(cols):
    free = np.ones((40, cols), dtype=bool)
    free[15:25, cols // 3 : cols // 2] = False
    assert np.array_equal(thin(free), opencv(free))


def test_two_by_two_blob_vanishes_as_published():
    free = np.zeros((6, 6), dtype=bool)
    free[2:4, 2:4] = True
    assert not thin(free).any()


def test_rows_of_any_layout():
    rng = np.random.default_rng(1)
    free = rng.random((50, 90)) < 0.8
    assert np.array_equal(thin(np.asfortranarray(free)), thin(free))
    assert np.array_equal(thin(free[:, ::-1]), thin(free[:, ::-1].copy()))


@pytest.mark.parametrize('name', ['kth/50052748', 'kth/50052749', 'dungeon/d114', 'dungeon/d1848'])
def test_equals_opencv_on_floors(shared_data, name):
    free = world(shared_data, name)[0].free
    assert np.array_equal(thin(free), opencv(free))


@pytest.mark.parametrize(
    'rows',
    [
        ('.#..', '#..#', '###.', '###.', '#.#.', '.#..'),
        ('..#...', '...#.#', '.####.', '#.###.', '.#.#.#'),
    ],
)
def test_after_a_sub_iteration_without_changes_the_other_one_follows(rows):
    free = np.array([[cell == '#' for cell in row] for row in rows])
    assert np.array_equal(thin(free), literal(free))
