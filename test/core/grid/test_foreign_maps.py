"""Maps of other publishers: costs, and what is seen in them."""

import math

import numpy as np
import pytest

from thinmap_ros.core.grid.patch import GridFrame, GridPatch, occupancy_from_costs, scan_in_map
from thinmap_ros.core.se2 import pose


def crossing(known_cols=120, resolution=0.05, origin=(0.0, 0.0)):
    """Two corridors 1 m wide that cross, 6 x 6 m, known up to a column."""
    cells = np.full((120, 120), 100, dtype=np.int8)
    cells[50:70, 2:118] = 0
    cells[2:118, 50:70] = 0
    cells[:, known_cols:] = -1
    return GridPatch(GridFrame(*origin, resolution), cells)


def test_costs_below_lethal_are_free_space():
    cells = np.array([[-1, 0, 1, 50, 98, 99, 100]], dtype=np.int8)
    found = occupancy_from_costs(GridPatch(GridFrame(0.0, 0.0, 0.05), cells))
    assert found.cells.tolist() == [[-1, 0, 0, 0, 0, 0, 100]]


def test_what_a_map_shows_ends_at_walls_and_at_the_unknown():
    scan = scan_in_map(crossing(known_cols=100), pose(3.0, 3.0, 0.5 * math.pi), 8.0, 7)
    assert scan.stamp_ns == 7
    ahead, left, behind, right = (scan.ranges_m[i] for i in (180, 270, 0, 90))
    assert ahead == pytest.approx(2.9, abs=0.01)  # +y
    assert left == pytest.approx(2.9, abs=0.01)  # -x
    assert behind == pytest.approx(2.9, abs=0.01)  # -y
    assert right == pytest.approx(2.0, abs=0.01)  # +x, up to the unknown
    near = scan_in_map(crossing(), pose(3.0, 3.0, 0.0), 2.0, 0)
    assert np.isinf(near.ranges_m[180])
