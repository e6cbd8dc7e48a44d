"""The heading by the main directions of the building's walls: new walls are rendered straight."""

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.line_extraction import LineConfig, extract_lines
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.covariance import PoseUncertainty
from thinmap_ros.core.slam.wall_compass import Heading, WallCompass

_NEW_SHARE = 0.2  # of the error of a match, from one update of the map to the next
_LEAST_VARIANCE = 5e-4**2


class HeadingCorrection:
    """Corrects the heading of scans that the map learns from."""

    def __init__(self, config: LineConfig) -> None:
        self._config = config
        self._compass = WallCompass()
        self._variance = _LEAST_VARIANCE  # of the heading since the walls' direction told it
        self.measured: Heading | None = None  # of the scan that was corrected last

    def correct(
        self, scan: Scan, T_map_base: Array, pose: PoseUncertainty, path_m: float, fits: bool
    ) -> Array:
        """Pose (3,) with the heading that walls tell, or as it was where nothing fits.

        path_m: length of the path so far, m: the compass trusts the beginning of the map most.
        """
        # Narrower than the variance of the pose: where the heading errs by more, the local map errs
        # with it, and a robot that is turned alone does not fit that map any more.
        self._variance += float(pose.motion_part[2, 2] + _NEW_SHARE * pose.by_scan[2, 2])
        self.measured = None
        if not fits:
            return T_map_base
        lines = extract_lines(scan, self._config)
        x, y, heading = T_map_base.tolist()
        self.measured = self._compass.read(lines, heading, self._variance)
        if self.measured is not None:
            gain = self._variance / (self._variance + self.measured.variance)
            heading = float(se2.wrap(heading + gain * (self.measured.yaw - heading)))
            self._variance *= 1.0 - gain
        self._compass.learn(lines, heading, path_m)
        return se2.pose(x, y, heading)
