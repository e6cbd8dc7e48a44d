"""Invalid messages and parameters, at the conversions of the nodes."""

from pathlib import Path
from typing import Any

import numpy as np

from fuzz.cases import Source, chosen, nothing, tried
from fuzz.files import strange_value
from fuzz.strange_messages import CHECKS, made
from thinmap_ros.core.config import Config, parameters_of, with_values
from thinmap_ros.core.ekf_slam.ekf_localizer import EkfConfig, EkfLocalizer
from thinmap_ros.core.exploration.explorer import ExplorerConfig
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.places.place_database import GlobalLocalizationConfig
from thinmap_ros.core.planning.navigator import Navigator, NavigatorConfig
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import TopologyBuilder
from thinmap_ros.logs.log import LaserOptions
from thinmap_ros.view.interface import NullView
from thinmap_ros.view.message_view import MessageView

_COUNT = 10
_KINDS = sorted(CHECKS, key=lambda kind: kind.__name__)
_CONFIGS: tuple[type[Config], ...] = (
    EkfConfig,
    ExplorerConfig,
    GlobalLocalizationConfig,
    LaserOptions,
    LocalizerConfig,
    NavigatorConfig,
    OccupancyConfig,
    TopologyConfig,
)
_MADE: dict[type[Config], Any] = {
    EkfConfig: EkfLocalizer,
    LocalizerConfig: Localizer,
    NavigatorConfig: Navigator,
    OccupancyConfig: OccupancyGrid,
    TopologyConfig: TopologyBuilder,
}
_TOPICS = {
    'LaserScan': ('scan',),
    'Odometry': ('odom',),
    'PoseWithCovarianceStamped': ('pose',),
    'OccupancyGrid': ('map',),
    'ProbabilityGrid': ('grid',),
    'TopologicalMap': ('topology',),
}


_SHOWN = [kind for kind in _KINDS if kind.__name__ in _TOPICS]


def take_messages(shared: None, rng: np.random.Generator, folder: Path) -> None:
    kind = chosen(rng, _KINDS)
    messages = made(kind, _COUNT, int(rng.integers(2**32)))
    (folder / 'messages.txt').write_text('\n'.join(map(repr, messages)))
    for message in messages:
        tried(lambda heard=message: CHECKS[kind](heard))


def show_messages(shared: None, rng: np.random.Generator, folder: Path) -> None:
    """Conversions of the viewer."""
    feed = MessageView(NullView(), lambda frame: np.zeros(3))
    told = []
    for _ in range(3):
        kind = chosen(rng, _SHOWN)
        for message in made(kind, 3, int(rng.integers(2**32))):
            told.append(repr(message))
            (folder / 'messages.txt').write_text('\n'.join(told))
            topic = chosen(rng, _TOPICS[kind.__name__])
            tried(lambda heard=message, where=topic: feed.show(where, heard))


def set_parameters(shared: None, rng: np.random.Generator, folder: Path) -> None:
    kind = chosen(rng, _CONFIGS)
    defaults = kind()
    declared = list(parameters_of(defaults))
    values: dict[str, Any] = {}
    for _ in range(int(rng.integers(1, 4))):
        name, field, _ = chosen(rng, declared)
        value = strange_value(rng)
        if isinstance(field.default, float) and rng.random() < 0.5:
            value = field.default * float(chosen(rng, (-1.0, 0.0, 0.01, 0.5, 2.0, 100.0)))
        values[name] = value
    (folder / 'parameters.txt').write_text(f'{kind.__name__} {values}\n')
    config = tried(lambda: with_values(defaults, values))
    if config is not None and kind in _MADE:
        tried(lambda: _MADE[kind](config))


SOURCES = (
    Source('messages', nothing, take_messages),
    Source('viewer', nothing, show_messages),
    Source('parameters', nothing, set_parameters),
)
