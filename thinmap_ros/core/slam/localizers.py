"""The available localizers, and their selection by the parameter `slam`."""

from collections.abc import Mapping
from typing import Any, Protocol

from thinmap_ros.core.config import parameters_of, with_values
from thinmap_ros.core.ekf_slam.ekf_localizer import EkfConfig, EkfLocalizer
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.snapshot import State
from thinmap_ros.core.stage import StartConfig

AnyLocalizer = Localizer | EkfLocalizer


class LocalizerClass(Protocol):
    """What makes localizers; config: of the class that belongs to them."""

    def __call__(self, config: Any) -> AnyLocalizer:
        """With an empty map, at the configured initial pose."""

    def from_state(self, state: State, config: Any) -> AnyLocalizer:
        """In the map of a saved state, at the configured initial pose."""


_LOCALIZERS: dict[type[StartConfig], LocalizerClass] = {
    LocalizerConfig: Localizer,
    EkfConfig: EkfLocalizer,
}
_CONFIGS = {slam: config for config in _LOCALIZERS for slam in config.of_slam}


def config_class(slam: str) -> type[StartConfig]:
    """Class of the configuration of the localizer that `slam` selects.

    Raises ConfigError for another value.
    """
    return _CONFIGS[StartConfig(slam=slam).slam]


def localizer_class(config: StartConfig) -> LocalizerClass:
    """Class of the localizer that a configuration is for."""
    return _LOCALIZERS[type(config)]


def default_config(slam: str) -> StartConfig:
    """Defaults of the localizer that `slam` selects. Raises ConfigError for another value."""
    return config_class(slam)(slam=slam)


def config_with(values: Mapping[str, Any]) -> StartConfig:
    """Configuration of the localizer that `slam` among the values selects, with these values.

    values: by the full names of the parameters. Raises ConfigError for a parameter that this
    localizer does not have, or a value that is not allowed.
    """
    config = default_config(values.get('slam', StartConfig.slam))
    return with_values(config, values)


def parameters_elsewhere(slam: str) -> dict[str, str]:
    """Names of the parameters that only other localizers have, with the `slam` of these in words.

    Raises ConfigError for another value.
    """
    own = _names(config_class(slam))
    return {
        name: f'slam: {" or ".join(config.of_slam)}'
        for config in _LOCALIZERS
        for name in _names(config)
        if name not in own
    }


def adjust(localizer: AnyLocalizer, config: StartConfig) -> None:
    """Continue with other values of `LIVE_PARAMETERS`, which are all of scan matching."""
    if isinstance(localizer, Localizer) and isinstance(config, LocalizerConfig):
        localizer.adjust(config)


def _names(config: type[StartConfig]) -> list[str]:
    return [name for name, _, _ in parameters_of(config())]
