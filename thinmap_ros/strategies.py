"""Exploration strategies by name: the project's own, the baselines, and a user's.

A strategy is named by one of NAMES, or by the import path `package.module:factory` of a factory
that takes nothing and returns a `core.exploration.strategy.Strategy`.
"""

from collections.abc import Callable
from functools import partial
from importlib import import_module

from thinmap_ros.core.errors import ConfigError, one_line_reason, quoted
from thinmap_ros.core.exploration.explorer import Explorer, ExplorerConfig
from thinmap_ros.core.exploration.paper import PaperConfig, PaperExplorer
from thinmap_ros.core.exploration.strategy import Strategy

DEFAULT = 'position_probability'
_PAPER = 'paper'
# Imported on demand: a robot needs none of them.
_BASELINES = {
    'nearest_frontier': 'NearestFrontier',
    'visit_all_end_nodes': 'VisitAllEndNodes',
    'explore_lite': 'ExploreLite',
    'information_gain': 'InformationGain',
    'bounded_tour': 'BoundedTour',
}
NAMES = (DEFAULT, _PAPER, *_BASELINES)
_EXPECTED = f'expected one of {", ".join(NAMES)}, or package.module:factory'


def make_strategy(name: str, config: ExplorerConfig | None = None) -> Strategy:
    """Make a strategy; config: of `position_probability`, of which `paper` has the threshold only.

    Raises ConfigError where the name is unknown, or its factory does not return a strategy.
    """
    factory = _factory(name, config or ExplorerConfig())
    try:
        strategy = factory()
    except Exception as error:  # whatever the factory of a user raises
        raise _refused(name, f'its factory fails: {one_line_reason(error)}') from error
    if isinstance(strategy, type) or not isinstance(strategy, Strategy):
        found = f'its factory returns a {type(strategy).__name__}'
        raise _refused(name, f'{found}, not a strategy with step and target_failed')
    return strategy


def check_strategy(name: str) -> None:
    """Raise ConfigError where there is no strategy of this name, or it cannot be imported."""
    _factory(name, ExplorerConfig())


def _factory(name: str, config: ExplorerConfig) -> Callable[[], object]:
    if name == DEFAULT:
        return partial(Explorer, config)
    if name == _PAPER:
        return partial(PaperExplorer, PaperConfig(config.probability_threshold))
    if name in _BASELINES:
        return _imported(name, 'thinmap_ros.baselines.exploration', _BASELINES[name])
    module, colon, attribute = name.partition(':')
    if not (module and colon and attribute):
        raise ConfigError(f'strategy = {quoted(name)}: {_EXPECTED}')
    return _imported(name, module, attribute)


def _imported(name: str, module: str, attribute: str) -> Callable[[], object]:
    try:
        factory = getattr(import_module(module), attribute)
    except Exception as error:  # whatever the module of a user raises
        raise _refused(name, one_line_reason(error)) from error
    if not callable(factory):
        raise _refused(name, f'it is a {type(factory).__name__}, not a factory')
    return factory  # type: ignore[no-any-return]


def _refused(name: str, problem: str) -> ConfigError:
    return ConfigError(f'strategy = {quoted(name)}: {problem}: {_EXPECTED}')
