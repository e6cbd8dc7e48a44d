"""The available localizers, and their selection by configuration."""

from thinmap_ros.core.config import parameters_of
from thinmap_ros.core.ekf_slam.ekf_localizer import EkfLocalizer
from thinmap_ros.core.ekf_slam.features import LineFeature
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.localizer_config import LocalizerConfig
from thinmap_ros.core.topology.graph import TopologicalMap

AnyLocalizer = Localizer | EkfLocalizer
_OF_FILTERS = ('association', 'features')
_OF_SCAN_MATCHING = ('lost_threshold', 'matching', 'local_map', 'keyframes', 'loop_closure')


def localizer_class(config: LocalizerConfig) -> type[Localizer] | type[EkfLocalizer]:
    """Class of the localizer that `config.slam` selects."""
    return EkfLocalizer if config.slam.startswith('ekf') else Localizer


def without_effect(config: LocalizerConfig) -> list[str]:
    """Names of parameters with another value than their default that the localizer does not use."""
    is_filter = localizer_class(config) is EkfLocalizer
    unused = _OF_SCAN_MATCHING if is_filter else _OF_FILTERS
    usual = {name: default for name, _, default in parameters_of(LocalizerConfig())}
    return [
        name
        for name, _, value in parameters_of(config)
        if name.partition('.')[0] in unused and value != usual[name]
    ]


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
