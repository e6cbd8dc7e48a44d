"""The heading by what is straight: line features, and the main directions of the building's walls.

Lines are longer than what a match sees of them, and hold the heading better; the place is told by
cells. New walls are then rendered straight.
"""

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.line_map import LineMap
from thinmap_ros.core.ekf_slam.lines import extract_lines
from thinmap_ros.core.ekf_slam.localizer import EkfConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.uncertainty import PoseUncertainty
from thinmap_ros.core.slam.wall_compass import WallCompass

# Covariance of a matched pose, as seen from walls that were seen some way back: what matching adds
# there to the error.
_BESIDE_WALLS = np.diag(np.square([5e-3, 5e-3, 3e-3]))
_NEW_SHARE = 0.2  # of the error of a match, from one update of the map to the next
_LEAST_VARIANCE = 5e-4**2


class HeadingCorrection:
    """Corrects the heading of scans that the map learns from."""

    def __init__(self, config: EkfConfig) -> None:
        self.lines = LineMap(config, config.slam == 'ti')
        self._config = config
        self._compass = WallCompass()
        self._variance = _LEAST_VARIANCE  # of the heading since the walls' direction told it

    def correct(
        self, scan: Scan, T_map_base: Array, pose: PoseUncertainty, path_m: float, fits: bool
    ) -> Array:
        """Pose (3,) with the heading that lines and walls tell, or as it was where nothing fits.

        path_m: length of the path so far, m: the compass trusts the beginning of the map most.
        """
        self._variance += float(pose.by_motion[2, 2] + _NEW_SHARE * pose.by_scan[2, 2])
        lines = extract_lines(scan, self._config)
        heading = float(T_map_base[2])
        if self._config.slam == 'ti':
            heading = self.lines.observe(scan, lines, T_map_base, _BESIDE_WALLS)
        if not fits:
            return T_map_base
        told = self._compass.read(lines, heading, self._variance)
        if told is not None:
            gain = self._variance / (self._variance + told.variance)
            heading = float(se2.wrap(heading + gain * (told.yaw - heading)))
            self._variance *= 1.0 - gain
        self._compass.learn(lines, heading, path_m)
        return se2.pose(float(T_map_base[0]), float(T_map_base[1]), heading)
