"""Configurations check their values."""

import math
from dataclasses import dataclass

import pytest

from thinmap_ros.core.config import (
    Config,
    parameter,
    parameters_of,
    part,
    robot_radius,
    with_values,
)
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


@dataclass(frozen=True)
class Inner(Config):
    robot_radius_m: float = robot_radius()
    size_m: float = parameter(1.0, 'size, m', low=0.0, high=2.0)
    step_m: float = 0.1


@dataclass(frozen=True)
class Outer(Config):
    speed: float = parameter(0.2, 'speed, m/s', low=0.0, high=2.0)
    inner: Inner = part(Inner)


def test_parameters_of_a_part_have_its_name_but_not_those_of_the_robot():
    found = {name: value for name, _, value in parameters_of(Outer())}
    assert found == {'speed': 0.2, 'robot_radius_m': 0.25, 'inner.size_m': 1.0}


def test_a_fixed_field_is_no_parameter_but_can_be_set_in_python():
    fixed = Outer(inner=Inner(step_m=0.2))
    assert 'inner.step_m' not in [name for name, _, _ in parameters_of(fixed)]
    assert with_values(fixed, {'inner.size_m': 0.5}).inner == Inner(size_m=0.5, step_m=0.2)
    with pytest.raises(ConfigError, match=r'no parameter inner\.step_m'):
        with_values(fixed, {'inner.step_m': 0.3})


def test_values_are_given_by_full_names():
    config = with_values(Outer(), {'inner.size_m': 0.5, 'robot_radius_m': 0.3, 'speed': 1.0})
    assert config == Outer(speed=1.0, inner=Inner(robot_radius_m=0.3, size_m=0.5))


@pytest.mark.parametrize('name', ['size_m', 'inner', 'inner.speed', 'inner.robot_radius_m'])
def test_a_name_that_there_is_not_is_an_error_that_lists_those_that_there_are(name):
    with pytest.raises(ConfigError, match=f'no parameter {name}: expected one of speed, robot_ra'):
        with_values(Outer(), {name: 1.0})


def test_a_wrong_value_of_a_part_is_named_in_full():
    with pytest.raises(ConfigError, match=r'inner\.size_m = 3.0: expected 0.0 to 2.0'):
        with_values(Outer(), {'inner.size_m': 3.0})
