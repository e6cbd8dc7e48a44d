"""Cells of large maps as they are drawn."""

import numpy as np

from thinmap_ros.view.summary import DrawnCells, block_maximum, reduced, reduction


def test_a_large_map_is_reduced_so_that_walls_stay():
    assert reduction((10, 1100)) == 1
    assert reduction((10, 1101)) == 2
    occupied = np.array([[False] * 4 + [True]] * 3)
    free, walls = reduced(DrawnCells(~occupied, occupied), 2)
    assert free.tolist() == [[True, True, False]] * 2
    assert walls.tolist() == [[False, False, True]] * 2
    assert block_maximum(np.arange(6).reshape(2, 3), 2).tolist() == [[4, 5]]
