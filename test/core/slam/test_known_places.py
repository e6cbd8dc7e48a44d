"""Places that enclose the map of a localizer: an initial pose distant from them is an error."""

import numpy as np
import pytest
from support.slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.slam.localizer import Localizer, config_with, localizer_class


@pytest.mark.parametrize('slam', ['scan_matching', 'ekf_ti'])
def test_they_enclose_the_walls_that_were_seen(slam):
    config = config_with({'slam': slam, 'initial_x_m': 2.0, 'initial_y_m': 2.0})
    localizer = localizer_class(config)(config)
    assert localizer.known_places().shape == (0, 2)
    rng = np.random.default_rng(1)
    for k in range(8):
        T_odom_base = se2.pose(0.1 * k, 0.0, 0.0)
        T_map_base = se2.compose(se2.pose(2.0, 2.0, 0.0), T_odom_base)
        localizer.step(scan_in(ROOM, T_map_base, rng, k * 200_000_000), T_odom_base)
    places = localizer.known_places()
    low = places.min(axis=0)
    high = places.max(axis=0)
    # The robot looks along x: the wall at y = 0 and the inner wall at y = 5 are in view.
    assert np.all(low < (3.5, 0.1)) and np.all(high > (6.5, 4.9))
    assert np.all(low > -5.0) and np.all(high < 15.0)


def test_those_of_a_given_map_are_its_corners():
    cells = np.zeros((60, 100), dtype=np.int8)
    cells[0] = cells[-1] = 100
    patch = GridPatch(GridFrame(-40.0, 20.0, 0.1), cells)
    places = Localizer.in_occupancy_map(patch).known_places()
    np.testing.assert_allclose(places.min(axis=0), (-40.0, 20.0), atol=3.3)
    np.testing.assert_allclose(places.max(axis=0), (-30.0, 26.0), atol=3.3)
