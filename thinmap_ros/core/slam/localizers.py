"""The localizers, and which of them a configuration asks for."""

from thinmap_ros.core.ekf_slam.localizer import EkfLocalizer
from thinmap_ros.core.slam.scan_localizer import ScanLocalizer, ScanLocalizerConfig

AnyLocalizer = ScanLocalizer | EkfLocalizer


def localizer_class(config: ScanLocalizerConfig) -> type[ScanLocalizer] | type[EkfLocalizer]:
    """The class of the localizer of `config.slam`."""
    return EkfLocalizer if config.slam.startswith('ekf') else ScanLocalizer
