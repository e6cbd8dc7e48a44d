"""The localizers, and which of them a configuration asks for."""

from thinmap_ros.core.ekf_slam.ekf_localizer import EkfLocalizer
from thinmap_ros.core.ekf_slam.features import LineFeature
from thinmap_ros.core.slam.localizer import Localizer, LocalizerConfig
from thinmap_ros.core.topology.graph import TopologicalMap

AnyLocalizer = Localizer | EkfLocalizer


def localizer_class(config: LocalizerConfig) -> type[Localizer] | type[EkfLocalizer]:
    """The class of the localizer of `config.slam`."""
    return EkfLocalizer if config.slam.startswith('ekf') else Localizer


def line_features(localizer: AnyLocalizer) -> list[LineFeature]:
    """The line features of a localizer; scan matching has none."""
    return localizer.features if isinstance(localizer, EkfLocalizer) else []


def set_topology(localizer: AnyLocalizer, topology: TopologicalMap) -> None:
    """Set the topological map by which a localizer stores its features."""
    if isinstance(localizer, EkfLocalizer):
        localizer.set_topology(topology)
