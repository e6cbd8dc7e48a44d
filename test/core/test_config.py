"""Configurations check their values."""

import math
from dataclasses import dataclass

import pytest

from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import ConfigError


@dataclass(frozen=True)
class Sample(Config):
    speed: float = parameter(0.2, 'speed, m/s', low=0.0, high=2.0)
    count: int = parameter(3, 'how many', low=1)
    mode: str = parameter('full', 'which', choices=('full', 'off'))
    active: bool = parameter(True, 'whether')


def test_defaults_and_values_within_the_range_are_taken():
    assert Sample() == Sample(speed=0.2, count=3)
    assert Sample(speed=2).speed == 2


@pytest.mark.parametrize(
    'wrong',
    [
        {'speed': -0.1},
        {'speed': 2.1},
        {'speed': math.nan},
        {'speed': 'fast'},
        {'count': 0},
        {'count': 1.5},
        {'mode': 'maybe'},
        {'active': 1},
        {'count': True},
    ],
)
def test_a_wrong_value_is_named(wrong):
    ((name, value),) = wrong.items()
    with pytest.raises(ConfigError) as caught:
        Sample(**wrong)
    assert name in str(caught.value)
    assert repr(value) in str(caught.value)


@pytest.mark.parametrize('name', ['speed', 'count'])
def test_a_number_beyond_all_floats_is_none(name):
    with pytest.raises(ConfigError, match=f'{name} = a whole number of 1329 bits: expected a fin'):
        Sample(**{name: 10**400})
