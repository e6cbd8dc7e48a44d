"""Start poses of live tests, and a map without walls."""

import numpy as np

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.ros import messages

START = '2.0,2.0,0.9'

AT_START = {'initial_x_m': 2.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.9}


def empty_hall():
    """Free map of 12 x 12 m around the origin."""
    cells = np.zeros((120, 120), dtype=np.int8)
    return messages.grid_msg(GridPatch(GridFrame(-6.0, -6.0, 0.1), cells), 'map', 0)
