"""What a localizer says after a scan."""

from dataclasses import dataclass

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array


@dataclass(frozen=True, eq=False)
class Correction:
    """Poses (N, 3) of the keyframes before and after the pose graph was optimized."""

    before: Array
    after: Array

    def moved(self, k: int, T: Array) -> Array:
        """Where a pose (3,) that was found from keyframe k is now."""
        return se2.compose(self.after[k], se2.between(self.before[k], T))


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a step found.

    T_map_base (3,) with covariance (3, 3), T_map_odom (3,), and how it was found.

    observed, matched: lines of this scan, and those found among the features (both 0 where the
    robot stands still and the scan has nothing new to say); n_features, n_local: features in the
    map, and in the local area; match_quality: share of the scan's points on known ground that fit
    the map. lost: it could be anywhere, as the covariance says.
    correction: where a loop was closed in this step, what it did to the keyframes; T_map_base is
    then the corrected pose.
    """

    T_map_base: Array
    covariance: Array
    T_map_odom: Array
    observed: int = 0
    matched: int = 0
    n_features: int = 0
    n_local_features: int = 0
    inlier_ratio: float = 0.0
    lost: bool = False
    correction: Correction | None = None
