"""Parts of frontiers: their middle."""

import numpy as np
import pytest

from thinmap_ros.core.exploration.stretches import middle_one


@pytest.mark.parametrize('step', [(1, 0), (0, 1), (2, -1)])
def test_the_middle_one_is_nearest_to_the_centre(step):
    cells = np.array([20, 50]) + np.outer([4, 0, 1, 3, 2], step)
    assert middle_one(cells) == 4
    # The centre of three at one end and two at the other lies nearer to the three.
    cells = np.array([20, 50]) + np.outer([10, 10, 0, 1, 2], step)
    assert middle_one(cells) == 4


def test_of_equally_near_ones_it_is_the_first():
    assert middle_one(np.array([[7, 3], [9, 3], [7, 3]])) == 0
    assert middle_one(np.array([[9, 3], [7, 3]])) == 0
