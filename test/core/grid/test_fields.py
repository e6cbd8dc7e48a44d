"""Fields of cells, and tables by number of a cell, against SciPy and NumPy."""

import numpy as np
import pytest
from scipy import ndimage

from thinmap_ros.core.grid.fields import counts_of, distance_cells, looked_up, squared_distance
from thinmap_ros.core.grid.patch import GridFrame


@pytest.mark.parametrize('share', [0.0, 0.01, 0.3])
@pytest.mark.parametrize('is_rim_marked', [False, True])
def test_distances_are_exact(share: float, is_rim_marked: bool) -> None:
    rng = np.random.default_rng(1)
    for shape in ((1, 1), (1, 30), (25, 3), (40, 60)):
        marked = rng.random(shape) < share
        framed = np.pad(marked, 1, constant_values=is_rim_marked)
        expected = np.full(framed.shape, 1000.0)
        if framed.any():
            expected = ndimage.distance_transform_edt(~framed)
        expected = expected[1:-1, 1:-1]
        found = squared_distance(marked, is_rim_marked)
        assert found.dtype == np.int32
        np.testing.assert_array_equal(found, np.rint(expected**2))
        if not is_rim_marked:
            np.testing.assert_allclose(distance_cells(marked), expected)


@pytest.mark.parametrize('rows', [1, 32, 33, 100])
def test_tables_of_many_rows_are_those_of_all_at_once(rows: int) -> None:
    rng = np.random.default_rng(rows)
    numbers = rng.integers(-1, 9, (rows, 7)).astype(np.int32)
    values = rng.integers(0, 100, 10).astype(np.uint8)
    found = looked_up(values, numbers)
    assert found.dtype == values.dtype
    np.testing.assert_array_equal(found, values[numbers])
    cells = numbers >= 0
    np.testing.assert_array_equal(
        counts_of(numbers, cells, 12), np.bincount(numbers[cells], minlength=12)
    )


def test_the_cell_of_a_point_is_that_of_the_array_of_it() -> None:
    frame = GridFrame(-3.7, 12.35, 0.05)
    points = np.random.default_rng(0).uniform(-50.0, 50.0, (2000, 2))
    points[:500] = np.round(points[:500] / 0.05) * 0.05  # at the edges of cells
    assert [list(frame.cell_at(x, y)) for x, y in points.tolist()] == frame.cells_of(
        points
    ).tolist()
