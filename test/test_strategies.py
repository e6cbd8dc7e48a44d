"""Exploration strategies by name, or by the import path of a user's own."""

import pytest

from thinmap_ros.baselines.exploration import NearestFrontier
from thinmap_ros.core.errors import ConfigError
from thinmap_ros.core.exploration.explorer import Explorer, ExplorerConfig
from thinmap_ros.core.exploration.paper import PaperExplorer
from thinmap_ros.core.exploration.strategy import Strategy
from thinmap_ros.strategies import DEFAULT, NAMES, make_strategy

MODULE = """
from thinmap_ros.baselines.exploration import NearestFrontier

class Own(NearestFrontier):
    pass

def own(): return Own()
def number(): return 3
def a_class(): return Own
def needs(argument): return Own()
def fails(): raise ValueError('no licence' + chr(10) + 'second line')
no_factory = 3
"""


@pytest.fixture(autouse=True)
def user_module(tmp_path, monkeypatch):
    (tmp_path / 'user_strategies.py').write_text(MODULE)
    (tmp_path / 'broken_strategies.py').write_text('import nothing_of_the_kind')
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.parametrize('name', NAMES)
def test_each_name_makes_a_new_strategy_each_time(name):
    strategy = make_strategy(name)
    assert isinstance(strategy, Strategy)
    assert make_strategy(name) is not strategy


def test_the_config_is_of_the_own_strategies():
    config = ExplorerConfig(probability_threshold=0.8)
    first = make_strategy(DEFAULT, config)
    paper = make_strategy('paper', config)
    assert isinstance(first, Explorer)
    assert first.config == config
    assert isinstance(paper, PaperExplorer)
    assert paper.config.probability_threshold == 0.8
    assert isinstance(make_strategy('nearest_frontier', config), NearestFrontier)


@pytest.mark.parametrize('factory', ['own', 'Own'])
def test_an_import_path_makes_a_strategy(factory):
    assert type(make_strategy(f'user_strategies:{factory}')).__name__ == 'Own'


@pytest.mark.parametrize(
    ('name', 'problem'),
    [
        ('nearest', ''),
        ('', ''),
        ('user_strategies:', ''),
        (':own', ''),
        ('user_strategies', ''),
        ('nowhere.at.all:own', "No module named 'nowhere'"),
        ('broken_strategies:own', "No module named 'nothing_of_the_kind'"),
        ('user_strategies:other', "has no attribute 'other'"),
        ('user_strategies:no_factory', 'it is a int, not a factory'),
        ('user_strategies:number', 'returns a int, not a strategy'),
        ('user_strategies:a_class', 'not a strategy'),
        ('user_strategies:needs', 'its factory fails: needs() missing 1 required'),
        ('user_strategies:fails', 'its factory fails: no licence second line'),
        ('..relative:own', ''),
    ],
)
def test_a_wrong_name_is_refused_in_one_line_with_what_was_expected(name, problem):
    with pytest.raises(ConfigError) as raised:
        make_strategy(name)
    line = str(raised.value)
    assert line.startswith(f'strategy = {name!r}: ')
    assert problem in line
    assert 'expected one of position_probability, paper, nearest_frontier, ' in line
    assert line.endswith('or package.module:factory')
    assert '\n' not in line
