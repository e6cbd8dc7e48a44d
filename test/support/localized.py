"""Messages between localizer, mapper and what uses the map, made by hand."""

import math

import numpy as np

from thinmap_msgs.msg import LocalGrid, SlamStatus
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.stage import Estimate
from thinmap_ros.ros import messages
from thinmap_ros.ros.localized_scan import localized_scan_msg


def localized(scan, T_map_base, corrected_ns=0, state=SlamStatus.TRACKING):
    """A scan at a pose, as the localizer publishes it."""
    estimate = Estimate(np.asarray(T_map_base), 1e-4 * np.eye(3), np.zeros(3))
    header = messages.header('map', scan.stamp_ns)
    status = SlamStatus(header=header, state=state)
    return localized_scan_msg(scan, estimate, status, 'map', corrected_ns)


def local_grid(patch, T_map_base, ns, scan=None, state=SlamStatus.TRACKING, map_id=0):
    """A window of a map with a scan of the stamp, as the mapper publishes it."""
    if scan is None:
        scan = Scan.create(ns, np.full(181, 2.0), -math.pi / 2, math.pi / 180, 0.05, 8.0)
    grid = messages.probability_grid_msg(patch, 'map', ns, map_id=map_id)
    message = localized(scan, T_map_base, state=state)
    return LocalGrid(header=grid.header, localized=message, grid=grid)
