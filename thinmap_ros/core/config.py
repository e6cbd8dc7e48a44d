"""One home for each default: frozen dataclasses whose fields carry description and range.

A configuration is composed of others (`part`). Seen from ROS and the command line it is flat:
parameters of a part have its name before theirs, `matching.noise_m`.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar

from thinmap_ros.core.errors import ConfigError, shown


def parameter(
    default: Any,
    description: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: Sequence[str] | None = None,
) -> Any:
    """Declare a field of a Config: its default, what it means (with unit), and its allowed values.

    low, high: inclusive bounds of a number; choices: the allowed strings.
    """
    metadata = {'description': description, 'low': low, 'high': high, 'choices': choices}
    return dataclasses.field(default=default, metadata=metadata)


def part(config: type['Config']) -> Any:
    """Declare a field of a Config that is itself a Config, with its defaults."""
    return dataclasses.field(default_factory=config)


@dataclasses.dataclass(frozen=True)
class Config:
    """Base of every configuration: values are checked once, on construction.

    Raises ConfigError naming the parameter, its value and what was expected.
    """

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if 'description' in field.metadata:
                _check(field, getattr(self, field.name))


AnyConfig = TypeVar('AnyConfig', bound=Config)


def parameters_of(config: Config) -> Iterator[tuple[str, 'dataclasses.Field[Any]', Any]]:
    """Full name, field and value of each parameter of a configuration and its parts."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if isinstance(value, Config):
            for name, inner, own in parameters_of(value):
                yield f'{field.name}.{name}', inner, own
        else:
            yield field.name, field, value


def with_values(config: AnyConfig, values: Mapping[str, Any]) -> AnyConfig:
    """Return a configuration with other values of some parameters, by their full names.

    Raises ConfigError for a parameter that it does not have, or a value that is not allowed.
    """
    own: dict[str, Any] = {}
    inner: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        first, _, rest = name.partition('.')
        if rest:
            inner.setdefault(first, {})[rest] = value
        else:
            own[first] = value
    names = {field.name for field in dataclasses.fields(config)}
    for name in [*own, *inner]:
        is_part = name in names and isinstance(getattr(config, name), Config)
        if name not in names or is_part != (name in inner):
            known = ', '.join(known for known, _, _ in parameters_of(config))
            raise ConfigError(f'no parameter {name}: expected one of {known}')
    for name, given in inner.items():
        try:
            own[name] = with_values(getattr(config, name), given)
        except ConfigError as error:
            raise ConfigError(f'{name}.{error}') from error
    return dataclasses.replace(config, **own)


def _check(field: 'dataclasses.Field[Any]', value: Any) -> None:
    low, high, choices = (field.metadata[key] for key in ('low', 'high', 'choices'))
    if not _same_type(value, field.default):
        expected = type(field.default).__name__
        raise ConfigError(f'{field.name} = {shown(value)}: expected a {expected}')
    if choices is not None and value not in choices:
        raise ConfigError(f'{field.name} = {shown(value)}: expected one of {", ".join(choices)}')
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    if not _is_finite(value):
        raise ConfigError(f'{field.name} = {shown(value)}: expected a finite number')
    if (low is not None and value < low) or (high is not None and value > high):
        raise ConfigError(f'{field.name} = {shown(value)}: expected {_interval(low, high)}')


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond all that can be calculated with
        return False


def _same_type(value: Any, default: Any) -> bool:
    if isinstance(default, bool) or isinstance(value, bool):
        return isinstance(default, bool) and isinstance(value, bool)
    if isinstance(default, float):
        return isinstance(value, int | float)
    return isinstance(value, type(default))


def _interval(low: float | None, high: float | None) -> str:
    if high is None:
        return f'at least {low}'
    return f'at most {high}' if low is None else f'{low} to {high}'
