"""Parameters of the localizer and of its parts."""

from dataclasses import dataclass
from typing import ClassVar

from thinmap_ros.core.config import parameter, parameters_of, part
from thinmap_ros.core.ekf_slam.features import LineConfig
from thinmap_ros.core.slam.graph.keyframes import KeyframeConfig
from thinmap_ros.core.slam.graph.loop_closure import LoopClosureConfig
from thinmap_ros.core.slam.matching.local_map import LocalMapConfig
from thinmap_ros.core.slam.matching.scan_matcher import MatchingConfig
from thinmap_ros.core.slam.motion_model import MotionConfig
from thinmap_ros.core.stage import SCAN_MATCHING, StartConfig


@dataclass(frozen=True)
class LocalizerConfig(StartConfig):
    """Parameters of the localizer and of its parts."""

    of_slam: ClassVar[tuple[str, ...]] = (SCAN_MATCHING,)

    lost_threshold: float = parameter(
        4.0,
        'Evidence against the map at which the robot is lost and a new submap begins: the sum over '
        'scans of the ratio of points that contradict the map, minus a third of the inlier ratio. '
        'Raise it in crowded places, lower it to detect a kidnapped robot earlier.',
        low=0.1,
        high=1000.0,
    )
    odometry: MotionConfig = part(MotionConfig)
    lines: LineConfig = part(LineConfig)
    matching: MatchingConfig = part(MatchingConfig)
    local_map: LocalMapConfig = part(LocalMapConfig)
    keyframes: KeyframeConfig = part(KeyframeConfig)
    loop_closure: LoopClosureConfig = part(LoopClosureConfig)


# What can change while a map is kept: `Localizer.adjust`.
LIVE_PARAMETERS = (
    'lost_threshold',
    *(f'matching.{name}' for name, _, _ in parameters_of(MatchingConfig())),
    *(f'loop_closure.{name}' for name, _, _ in parameters_of(LoopClosureConfig())),
)
