"""Manhattan-world heading correction of the scans that are added to the local map."""

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.features import LineConfig, extract_lines
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.odometry import OdometryCalibration, PoseUncertainty
from thinmap_ros.core.slam.wall_compass import Heading, Reference, WallCompass


class HeadingCorrection:
    """Corrects the heading of scans before they are added to the map."""

    def __init__(
        self,
        config: LineConfig,
        calibration: OdometryCalibration,
        min_sigma_rad: float = 5e-4,
        new_ratio: float = 0.2,
    ) -> None:
        """new_ratio: of a match's error, that is independent of the previous map update."""
        self._calibration = calibration
        self._revision = 0
        self._new_ratio = new_ratio
        self._config = config
        self._compass = WallCompass()
        self._variance = min_sigma_rad**2  # of the heading since its last measurement
        self.measured: Heading | None = None  # measured heading of the last scan

    def correct(
        self,
        scan: Scan,
        T_map_base: Array,
        pose: PoseUncertainty,
        path_m: float,
        fits: bool,
        own: Reference,
        revision: int,
    ) -> Array:
        """Pose (3,) with the heading corrected by the wall directions, if they give one.

        path_m: length of the path so far (m); walls near the start of the path weigh most.
        fits: whether scans agree with the map; otherwise the pose is unchanged; own: error of the
        heading, relative to where the map began; revision: number of corrections of the map, with
        which the main direction turns as the calibration of the odometry has it.
        """
        if revision != self._revision:
            self._revision = revision
            self._compass.calibrate(self._calibration.smoothed())
        # The gate is narrower than the variance of the pose: a larger heading error is also in the
        # local map, and a scan that is corrected alone would no longer fit this map.
        self._variance += float(pose.motion_part[2, 2] + self._new_ratio * pose.scan_part[2, 2])
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
        self._compass.add_lines(lines, heading, path_m, own)
        return se2.pose(x, y, heading)
