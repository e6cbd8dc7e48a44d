"""EKF-SLAM/TI, the filter of the paper alone: odometry predicts, line features correct.

Source: EKF-SLAM/TI paper sections 2 to 4. The state holds the pose and the features of the local
area, which the topological map selects (`ekf_ti`), or all features (`ekf_full`). Both have the same
estimate. There is no scan matching and no pose graph: associations are never revised, and a
kidnapped robot is not detected.
"""

from array import array
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import part
from thinmap_ros.core.ekf_slam import feature_map
from thinmap_ros.core.ekf_slam.ekf import CompressedEkf
from thinmap_ros.core.ekf_slam.feature_map import AssociationConfig, FeatureConfig, FeatureMap
from thinmap_ros.core.ekf_slam.features import (
    LineConfig,
    LineFeature,
    OdometryConfig,
    extract_lines,
    odometry_slip,
    odometry_variances,
)
from thinmap_ros.core.odometry import OdometryAnchor, OdometryIncrement, OdometryIncrements
from thinmap_ros.core.scan import Scan, few_beams_reason
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stage import EKF_FULL, EKF_TI, Estimate, StartConfig, slam_parameter
from thinmap_ros.core.topology.graph import TopologicalMap

_START = np.diag(np.square([1e-4, 1e-4, 1e-4]))  # of the initial pose, which defines the map frame
_IN_SESSION = np.diag(np.square([0.3, 0.3, 0.15]))  # of the initial pose in a loaded map
# The filter assumes independent odometry errors and does not calibrate the systematic ones. This
# factor of the standard deviation makes up for their accumulation.
_REPEATED = 5.0
_SLIP_SIGMAS = 3.0  # a motion within so many sigmas of the noise floor is not predicted yet


@dataclass(frozen=True)
class EkfConfig(StartConfig):
    """Parameters of the filter and of its parts."""

    of_slam: ClassVar[tuple[str, ...]] = (EKF_TI, EKF_FULL)

    slam: str = slam_parameter(EKF_TI)
    odometry: OdometryConfig = part(OdometryConfig)
    lines: LineConfig = part(LineConfig)
    association: AssociationConfig = part(AssociationConfig)
    features: FeatureConfig = part(FeatureConfig)


class EkfLocalizer:
    """EKF-SLAM with the interface of a localizer.

    Input that is not finite is counted in `rejected`; a rejected odometry pose means no motion.
    """

    follows_topology: ClassVar[bool] = True  # its nodes select the local area

    def __init__(self, config: EkfConfig | None = None) -> None:
        self.config = config or EkfConfig()
        self._rejected = 0
        self.reset()

    def reset(self) -> None:
        """Discard map, path and pose; the next scan starts at the configured initial pose."""
        config = self.config
        start = se2.pose(config.initial_x_m, config.initial_y_m, config.initial_yaw_rad)
        self._filter = CompressedEkf(start, _START)
        self._features = FeatureMap(
            config.features, config.association, local_areas=config.slam == EKF_TI
        )
        self._odometry = OdometryIncrements()
        self._moved: Array = np.zeros(3)  # motion that the filter has not predicted yet
        self._is_observation_due = True
        self._path = array('d')

    @property
    def rejected(self) -> int:
        """Number of scans, odometry poses and `set_pose` calls with invalid values."""
        return self._rejected + self._odometry.rejected

    @property
    def pose(self) -> Array:
        """Current pose T_map_base (3,)."""
        return se2.compose(self._filter.local.pose, self._moved)

    @property
    def features(self) -> list[LineFeature]:
        """The line features of the map."""
        return self._features.line_features(self._filter)

    def set_topology(self, topology: TopologicalMap) -> None:
        """Set the topological map that selects the local area."""
        self._features.area.set_topology(topology)

    def set_pose(self, T_map_base: Array, covariance: Array) -> None:
        """Set the pose (3,) with covariance (3, 3) in the current map."""
        if not (se2.is_bounded_pose(T_map_base) and np.isfinite(covariance).all()):
            self._rejected += 1
            return
        self._filter.local.set_pose(T_map_base, covariance + _START)
        self._moved = np.zeros(3)
        self._is_observation_due = True

    def state(self) -> dict[str, NDArray[Any]]:
        """The features as arrays by name, for `from_state`; without the pose."""
        return self._features.state(self._filter)

    @staticmethod
    def from_state(
        state: Mapping[str, NDArray[Any]], config: EkfConfig | None = None
    ) -> 'EkfLocalizer':
        """EkfLocalizer with the features of a saved `state`, at the configured initial pose.

        Raises InputError if the state is invalid.
        """
        own = {name: array for name, array in state.items() if name in feature_map.FIELDS}
        localizer = EkfLocalizer(config)
        localizer._features.restore(
            localizer._filter, snapshot.validate(own, feature_map.FIELDS, 'features')
        )
        localizer.set_pose(localizer.pose, _IN_SESSION)
        return localizer

    def resume(self, last: OdometryAnchor, T_odom_base: Array) -> None:
        """Continue at the last pose plus the odometry motion since, to T_odom_base (3,)."""
        moved = se2.between(last.T_odom_base, T_odom_base)
        self.set_pose(se2.compose(last.T_map_odom, T_odom_base), self._motion_noise(moved))

    def step(self, scan: Scan, T_odom_base: Array) -> Estimate:
        """Estimate the pose of a scan, given the odometry pose (3,) at its stamp; update the map.

        One step: predict, extract lines, update.
        """
        increment = self._odometry.add(scan, T_odom_base)
        self._predict(increment)
        observed = 0
        matched = 0
        if not se2.is_finite(scan.T_base_laser):
            self._rejected += 1
        elif self._is_observation_due:
            lines = extract_lines(scan, self.config.lines)
            observed = len(lines)
            matched, is_valid = self._features.observe(
                self._filter, lines, scan, learn=self.config.is_mapping
            )
            self._rejected += not is_valid
            self._is_observation_due = False  # a scan from the same pose is not independent
        self._filter.flush_step()
        self._path.extend(self.pose.tolist())
        return Estimate(
            self.pose,
            self._filter.local.pose_covariance,
            se2.compose(self.pose, se2.invert(self._odometry.T_odom_base)),
            observed,
            matched,
            len(self._features),
            len(self._filter.area),
            blind_reason=scan.blind_reason or few_beams_reason(scan),
            odometry_discontinuity=increment.discontinuity,
        )

    def optimized_trajectory(self) -> Array:
        """Poses (N, 3) of all steps; the filter does not correct earlier ones."""
        return np.array(self._path, dtype=np.float64).reshape(-1, 3)

    def corrected_trajectory(self) -> Array:
        """The same."""
        return self.optimized_trajectory()

    def keyframe_trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (0,) and poses (0, 3): the filter does not correct earlier poses."""
        return np.empty(0, dtype=np.int64), np.empty((0, 3))

    def apart_points(self) -> Array:
        """Scan points (0, 2) of pieces that are apart: a lost filter does not map."""
        return np.empty((0, 2))

    def known_places(self) -> Array:
        """Places (N, 2) that enclose what is known: the ends of the line features, m."""
        ends = [end for feature in self.features for end in (feature.start, feature.end)]
        return np.array(ends, dtype=np.float64).reshape(-1, 2)

    def _motion_noise(self, moved: Array) -> Array:
        """Covariance (3, 3) of an odometry motion (3,), robot frame before the motion."""
        return np.diag(_REPEATED**2 * odometry_variances(moved, self.config.odometry))

    def _predict(self, increment: OdometryIncrement) -> None:
        """Predict by eqs. (10) and (11) once the motion exceeds the odometry noise floor.

        So the covariance of a stationary robot does not change.
        """
        ekf = self._filter.local
        if increment.discontinuity_m > 0.0:
            unknown = np.diag(
                np.square([increment.discontinuity_m, increment.discontinuity_m, 1.0])
            )
            ekf.predict(ekf.pose, np.zeros(3), unknown)
            self._is_observation_due = True
            return
        self._moved = se2.compose(self._moved, increment.T_before_base)
        slip = _REPEATED * odometry_slip(self.config.odometry)
        if (np.abs(self._moved) > _SLIP_SIGMAS * slip).any():
            ekf.predict(self.pose, self._moved, self._motion_noise(self._moved))
            self._moved = np.zeros(3)
            self._is_observation_due = True
