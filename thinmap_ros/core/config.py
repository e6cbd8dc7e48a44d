"""Configuration: frozen dataclasses whose fields carry default, description and range."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from thinmap_ros.core.errors import ConfigError, quoted


def parameter(
    default: Any,
    description: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: Sequence[str] | None = None,
) -> Any:
    """Declare a field of a Config: default, description (with unit) and allowed values.

    low, high: inclusive bounds of a number; choices: the allowed strings.
    """
    metadata = {'description': description, 'low': low, 'high': high, 'choices': choices}
    return dataclasses.field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True)
class Config:
    """Base of every configuration; values are validated on construction.

    Raises ConfigError naming the parameter, its value and what was expected.
    """

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if 'description' in field.metadata:
                _check(field, getattr(self, field.name))


def _check(field: 'dataclasses.Field[Any]', value: Any) -> None:
    low, high, choices = (field.metadata[key] for key in ('low', 'high', 'choices'))
    if not _same_type(value, field.default):
        expected = type(field.default).__name__
        raise ConfigError(f'{field.name} = {quoted(value)}: expected a {expected}')
    if choices is not None and value not in choices:
        raise ConfigError(f'{field.name} = {quoted(value)}: expected one of {", ".join(choices)}')
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    if not _is_finite(value):
        raise ConfigError(f'{field.name} = {quoted(value)}: expected a finite number')
    if (low is not None and value < low) or (high is not None and value > high):
        raise ConfigError(f'{field.name} = {quoted(value)}: expected {_interval(low, high)}')


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer too large for float
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
