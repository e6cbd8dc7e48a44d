"""The available localizers, and their selection by configuration."""

from thinmap_ros.core.ekf_slam.ekf_localizer import EkfLocalizer
from thinmap_ros.core.ekf_slam.features import LineFeature
from thinmap_ros.core.slam.localizer import Localizer, LocalizerConfig
from thinmap_ros.core.topology.graph import TopologicalMap

AnyLocalizer = Localizer | EkfLocalizer


def localizer_class(config: LocalizerConfig) -> type[Localizer] | type[EkfLocalizer]:
    """Class of the localizer that `config.slam` selects."""
    return EkfLocalizer if config.slam.startswith('ekf') else Localizer


def line_features(localizer: AnyLocalizer) -> list[LineFeature]:
    """Line features of a localizer; empty for scan matching."""
    return localizer.features if isinstance(localizer, EkfLocalizer) else []


def adjust(localizer: AnyLocalizer, config: LocalizerConfig) -> None:
    """Continue with other values of `LIVE_PARAMETERS`, which are all of scan matching."""
    if isinstance(localizer, Localizer):
        localizer.adjust(config)


def set_topology(localizer: AnyLocalizer, topology: TopologicalMap) -> None:
    """Set the topological map with which an EKF localizer selects its local area."""
    if isinstance(localizer, EkfLocalizer):
        localizer.set_topology(topology)
