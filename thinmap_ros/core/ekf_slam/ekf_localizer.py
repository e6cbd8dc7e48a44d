"""EKF-SLAM/TI, the paper's filter alone: odometry predicts, line features correct.

Source: EKF-SLAM/TI paper sections 2 to 4. The state holds the pose and the features of the local
area, which the topological map picks (`ekf_ti`), or all features (`ekf_full`); both estimate the
same. There is no scan matching and no pose graph: what the filter once believed of a line stays,
and a robot that was carried off is not noticed.
"""

from array import array
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import Config, parameter, part
from thinmap_ros.core.ekf_slam import feature_map
from thinmap_ros.core.ekf_slam.association import AssociationConfig
from thinmap_ros.core.ekf_slam.ekf_ti import CompressedEkf
from thinmap_ros.core.ekf_slam.feature_map import FeatureConfig, FeatureMap
from thinmap_ros.core.ekf_slam.features import LineFeature
from thinmap_ros.core.ekf_slam.line_extraction import LineConfig, extract_lines
from thinmap_ros.core.ekf_slam.models import OdometryConfig, odometry_slip, odometry_variances
from thinmap_ros.core.estimate import Estimate
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.odometry import OdometryAnchor, OdometryIncrement, OdometryIncrements
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap

_START = np.diag(np.square([1e-4, 1e-4, 1e-4]))  # the map begins where the robot stands
_IN_SESSION = np.diag(np.square([0.3, 0.3, 0.15]))  # of a start in the map of another day
# The systematic errors of odometry repeat from step to step, and this filter does not calibrate
# them. It takes errors to be independent: these have to be so many times larger to add up to as
# much.
_REPEATED = 5.0
_SLIP_SIGMAS = 3.0  # a motion within so much of the slip is not counted yet


@dataclass(frozen=True)
class EkfConfig(Config):
    """Parameters of the filter, and of every localizer."""

    slam: str = parameter(
        'scan_matching',
        'scan_matching: scan matching with a pose graph; ekf_ti: EKF-SLAM/TI on odometry and line '
        'features alone; ekf_full: the same with all features in the state.',
        choices=('scan_matching', 'ekf_ti', 'ekf_full'),
    )
    initial_x_m: float = parameter(
        0.0,
        'Initial x position in the map (m).',
        low=-se2.MAX_COORDINATE_M,
        high=se2.MAX_COORDINATE_M,
    )
    initial_y_m: float = parameter(
        0.0,
        'Initial y position in the map (m).',
        low=-se2.MAX_COORDINATE_M,
        high=se2.MAX_COORDINATE_M,
    )
    initial_yaw_rad: float = parameter(0.0, 'Initial heading in the map (rad).')
    update_map: bool = parameter(
        True, 'true: mapping. false: localization in the loaded map, which does not change.'
    )
    odometry: OdometryConfig = part(OdometryConfig)
    lines: LineConfig = part(LineConfig)
    association: AssociationConfig = part(AssociationConfig)
    features: FeatureConfig = part(FeatureConfig)


class EkfLocalizer:
    """The filter behind the interface of a localizer.

    Input that is not finite is rejected and counted in `rejected`: the robot is then taken to be
    where it was.
    """

    def __init__(self, config: EkfConfig | None = None) -> None:
        self.config = config or EkfConfig(slam='ekf_ti')
        self._rejected = 0
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next scan is the first, at the configured start."""
        config = self.config
        start = se2.pose(config.initial_x_m, config.initial_y_m, config.initial_yaw_rad)
        self._filter = CompressedEkf(start, _START)
        self._features = FeatureMap(
            config.features, config.association, local_areas=config.slam == 'ekf_ti'
        )
        self._odometry = OdometryIncrements()
        self._moved: Array = np.zeros(3)  # since the filter's pose
        self._is_observation_due = True
        self._path = array('d')

    @property
    def rejected(self) -> int:
        """Scans, odometry poses and poses from outside that made no sense."""
        return self._rejected + self._odometry.rejected

    @property
    def pose(self) -> Array:
        """Where the robot is, T_map_base (3,)."""
        return se2.compose(self._filter.local.pose, self._moved)

    @property
    def features(self) -> list[LineFeature]:
        """The line features of the map."""
        return self._features.line_features(self._filter)

    def set_topology(self, topology: TopologicalMap) -> None:
        """Take the topological map by which features are stored."""
        self._features.area.set_topology(topology)

    def set_pose(self, T_map_base: Array, covariance: Array) -> None:
        """Put the robot at a pose (3,) with covariance (3, 3) in the map that it has."""
        if not (se2.is_bounded_pose(T_map_base) and np.isfinite(covariance).all()):
            self._rejected += 1
            return
        self._filter.local.set_pose(T_map_base, covariance + _START)
        self._moved = np.zeros(3)
        self._is_observation_due = True

    def state(self) -> dict[str, NDArray[Any]]:
        """The features as arrays by name, for `from_state`; not where the robot is."""
        return self._features.state(self._filter)

    @staticmethod
    def from_state(
        state: Mapping[str, NDArray[Any]], config: EkfConfig | None = None
    ) -> 'EkfLocalizer':
        """EkfLocalizer with the features of another localizer's `state`, at the configured start.

        Raises InputError where it is no such state.
        """
        own = {name: array for name, array in state.items() if name in feature_map.FIELDS}
        localizer = EkfLocalizer(config)
        localizer._features.restore(
            localizer._filter, snapshot.validate(own, feature_map.FIELDS, 'features')
        )
        localizer.set_pose(localizer.pose, _IN_SESSION)
        return localizer

    @staticmethod
    def from_occupancy_map(
        patch: GridPatch, last: OdometryAnchor, T_odom_base: Array, config: EkfConfig | None = None
    ) -> 'EkfLocalizer':
        """EkfLocalizer that goes on at T_odom_base (3,) after its last pose, with new features.

        The occupancy map is of no use to it.
        """
        localizer = EkfLocalizer(config)
        moved = se2.between(last.T_odom_base, T_odom_base)
        localizer.set_pose(
            se2.compose(last.T_map_odom, T_odom_base), localizer._motion_noise(moved)
        )
        return localizer

    def step(self, scan: Scan, T_odom_base: Array) -> Estimate:
        """Take in a scan with the odometry pose (3,) at its stamp."""
        self._predict(self._odometry.add(scan.stamp_ns, T_odom_base))
        observed = 0
        matched = 0
        if not se2.is_finite(scan.T_base_laser):
            self._rejected += 1
        elif self._is_observation_due:
            lines = extract_lines(scan, self.config.lines)
            observed = len(lines)
            matched, is_valid = self._features.observe(
                self._filter, lines, scan, learn=self.config.update_map
            )
            self._rejected += not is_valid
            self._is_observation_due = False  # the same scan again tells no more
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
        )

    def optimized_trajectory(self) -> Array:
        """Poses (N, 3) of all steps; a filter corrects none of the past."""
        return np.array(self._path, dtype=np.float64).reshape(-1, 3)

    def keyframe_trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (0,) and poses (0, 3): nothing of the past is ever corrected."""
        return np.empty(0, dtype=np.int64), np.empty((0, 3))

    def _motion_noise(self, moved: Array) -> Array:
        """Covariance (3, 3) of a motion (3,) by odometry, robot frame before it."""
        return np.diag(_REPEATED**2 * odometry_variances(moved, self.config.odometry))

    def _predict(self, increment: OdometryIncrement) -> None:
        """Eqs. (10) and (11), once the robot has moved by more than odometry slips.

        So a robot that stands grows no surer and no less sure, however many scans it takes.
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
