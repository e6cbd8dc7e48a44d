"""Other robots in a scan: beams that end at them are no evidence about the map."""

from dataclasses import replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array


def without_robots(scan: Scan, T_map_base: Array, places: Array, radius_m: float) -> Scan:
    """Scan made at a pose (3,) with the beams invalid that end within radius_m of places (M, 2), m.

    The beams beside these are invalid as well: their ranges may be mixed with those
    of walls behind.
    """
    hit = np.flatnonzero(scan.hit)
    if not len(places) or not hit.size:
        return scan
    T_map_laser = se2.compose(T_map_base, scan.T_base_laser)
    angles = scan.angles_rad[hit] + T_map_laser[2]
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    ends = T_map_laser[:2] + scan.ranges_m[hit, None] * directions
    away = np.hypot(*(ends[:, None] - places[None]).transpose(2, 0, 1))
    cut = hit[(away < radius_m).any(axis=1)]
    if not cut.size:
        return scan
    beams = np.concatenate([cut - 1, cut, cut + 1])
    ranges = scan.ranges_m.copy()
    ranges[beams[(beams >= 0) & (beams < ranges.size)]] = np.nan
    return replace(scan, ranges_m=ranges)
