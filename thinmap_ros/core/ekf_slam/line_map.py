"""The line features of a building, mapped from poses that scan matching has found.

They are kept as the filter of EKF-SLAM/TI keeps them, local by the topological map. They hold the
heading: a line is longer than what a scan is matched with, so its direction is known better. The
place is not theirs to move: real walls are farther off a line than off the cells of a local map.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.ekf_slam.ekf_ti import CompressedEkf
from thinmap_ros.core.ekf_slam.feature_map import FeatureConfig, FeatureMap
from thinmap_ros.core.ekf_slam.features import LineFeature
from thinmap_ros.core.ekf_slam.lines import Lines
from thinmap_ros.core.estimate import Correction
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap

_LEAST = np.diag(np.square([1e-3, 1e-3, 1e-4]))  # to which a pose is known at best


class LineMap:
    """Line features, and what the last observation found."""

    def __init__(self, features: FeatureConfig, local_areas: bool) -> None:
        self._filter = CompressedEkf(np.zeros(3), _LEAST)
        self._map = FeatureMap(features, local_areas)
        self.observed = 0
        self.matched = 0

    def __len__(self) -> int:
        return len(self._map)

    @property
    def local_count(self) -> int:
        """Features in the local area."""
        return len(self._filter.area)

    @property
    def features(self) -> list[LineFeature]:
        """The features as others see them."""
        return self._map.listed(self._filter)

    def set_topology(self, topology: TopologicalMap) -> None:
        """Take the topological map by which features are stored."""
        self._map.area.set_topology(topology)

    def observe(self, scan: Scan, lines: Lines, T_map_base: Array, covariance: Array) -> float:
        """Update the features by the lines of a scan at a pose (3,) with covariance (3, 3).

        Returns the heading that pose and features together tell, rad.
        """
        self._filter.local.set_pose(T_map_base, covariance + _LEAST)
        self.observed = len(lines)
        self.matched, _ = self._map.observe(self._filter, lines, scan)
        return float(self._filter.local.pose[2])

    def work_off(self) -> None:
        """Do a piece of what the filter has put off; to be called once a step."""
        self._filter.work_off()

    def rest(self) -> None:
        """The scan of this step was not observed."""
        self.observed = 0
        self.matched = 0

    def move(self, correction: Correction) -> None:
        """Take features where the keyframes have gone."""
        self._map.move(self._filter, correction)

    def state(self) -> dict[str, NDArray[Any]]:
        """All features as arrays by name, for `restore`."""
        return self._map.state(self._filter)

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Take up the `state` of another one, into an empty one.

        Raises InputError where its arrays contradict each other.
        """
        self._map.restore(self._filter, state)
