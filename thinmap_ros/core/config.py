"""One home for each default: frozen dataclasses whose fields carry description and range.

A configuration is composed of others (`part`). Seen from ROS and the command line it is flat:
parameters of a part have its name before theirs, `matching.noise_m`; those that describe the robot
(`robot_radius`, `laser_range_noise`) have one name everywhere. Fields without `parameter` are
fixed: they are set in Python only, and are no parameters of nodes.
"""

import dataclasses
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Self, TypeVar

from thinmap_ros.core.errors import ConfigError, did_you_mean, quoted, require_known, with_article

SAFE_LOWER = 'lower'
SAFE_HIGHER = 'higher'
# Of numbers whose range is not declared: seconds up to here are int64 nanoseconds.
_MAX_ABSOLUTE = 1e9


def parameter(
    default: Any,
    description: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: Sequence[str] | None = None,
    safe: str = '',
) -> Any:
    """Declare a field of a Config: default, description (with unit) and allowed values.

    low, high: inclusive bounds of a number; choices: the allowed strings; safe: SAFE_LOWER or
    SAFE_HIGHER, the only direction in which a value that concerns safety may change at run time.
    """
    metadata = {
        'description': description,
        'low': low,
        'high': high,
        'choices': choices,
        'safe': safe,
    }
    return dataclasses.field(default=default, metadata=metadata)


MAX_ROBOT_RADIUS_M = 5.0


def robot_radius() -> Any:
    """Declare the field `robot_radius_m`: one name and one default for all parts and nodes."""
    return _shared(
        0.25,
        'Radius of the robot (m), the same for all nodes. Set it to the distance from the centre '
        'of rotation to the farthest point of the footprint.',
        low=0.0,
        high=MAX_ROBOT_RADIUS_M,
        safe=SAFE_HIGHER,
    )


def laser_range_noise() -> Any:
    """Declare the field `laser_range_noise_m`: one name and one default for all parts and nodes."""
    return _shared(
        0.015,
        'Standard deviation of a range of the laser (m), the same for all nodes. Set it to the '
        'noise of the laser; too low, and walls break into pieces.',
        low=0.0005,
        high=0.5,
    )


def part(config: type['Config'], kind: type['Config'] | None = None) -> Any:
    """Declare a field of a Config that is itself a Config, with its defaults.

    kind: what the field may hold; None: configurations of the class of the default.
    """
    return dataclasses.field(default_factory=config, metadata={'kind': kind or config})


@dataclasses.dataclass(frozen=True)
class Config:
    """Base of every configuration; values are validated on construction.

    Raises ConfigError naming the parameter, its value and what was expected.
    """

    def __new__(cls, *_given: Any, **by_name: Any) -> Self:
        """Raises ConfigError for a name that is no field; else the object is made as always."""
        require_known(by_name, [field.name for field in dataclasses.fields(cls) if field.init])
        return super().__new__(cls)

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if is_parameter(field):
                _check(field, value)
            elif 'kind' in field.metadata:
                _require_kind(field.name, value, field.metadata['kind'])


def is_parameter(field: 'dataclasses.Field[Any]') -> bool:
    """Whether a field was declared by `parameter`, so that users can set it."""
    return 'description' in field.metadata


AnyConfig = TypeVar('AnyConfig', bound=Config)


def config_or_default(config: AnyConfig | None, kind: type[AnyConfig]) -> AnyConfig:
    """The configuration that a caller gives, or that of the defaults for None.

    Raises ConfigError where it is none of this kind.
    """
    if config is None:
        return kind()
    _require_kind('config', config, kind)
    return config


def parameters_of(config: Config) -> Iterator[tuple[str, 'dataclasses.Field[Any]', Any]]:
    """Full name, field and value of each parameter of a configuration and its parts."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if isinstance(value, Config):
            for name, inner, own in parameters_of(value):
                yield name if _is_shared(inner) else f'{field.name}.{name}', inner, own
        elif is_parameter(field):
            yield field.name, field, value


def with_values(config: AnyConfig, values: Mapping[str, Any]) -> AnyConfig:
    """Return a configuration with other values of some parameters, by their full names.

    Raises ConfigError for a parameter that it does not have, or a value that is not allowed.
    """
    known = [name for name, _, _ in parameters_of(config)]
    for name in values:
        if name not in known:
            raise ConfigError(f'no parameter {name}: expected one of {", ".join(known)}')
    own: dict[str, Any] = {}
    for field in dataclasses.fields(config):
        inner = getattr(config, field.name)
        if isinstance(inner, Config):
            own[field.name] = _part_with(field.name, inner, values)
        elif field.name in values:
            own[field.name] = values[field.name]
    return dataclasses.replace(config, **own)


def suggestion(
    name: str, known: Collection[str], elsewhere: Mapping[str, str] | None = None
) -> str:
    """The parameter that was probably meant: in another group, or with a similar name.

    elsewhere: parameters that exist with another value of `slam` or the like, and that value.
    """
    if elsewhere and name in elsewhere:
        return f' (only with {elsewhere[name]})'
    last = name.split('.')[-1]
    same = [other for other in sorted(known) if other.split('.')[-1] == last]
    return f' (did you mean {", ".join(same)}?)' if same else did_you_mean(name, known, 0.75)


def check_safety(start: Config, changed: Config) -> None:
    """Check that no parameter makes a running robot less safe than the configuration at its start.

    Raises ConfigError naming the parameter, its value and what was expected.
    """
    values = {name: value for name, _, value in parameters_of(changed)}
    for name, field, bound in parameters_of(start):
        value = values[name]
        safe = field.metadata['safe']
        if safe == SAFE_LOWER and value > bound:
            raise ConfigError(f'{name} = {value}: expected at most {bound}, as at the start')
        if safe == SAFE_HIGHER and value < bound:
            raise ConfigError(f'{name} = {value}: expected at least {bound}, as at the start')


def _part_with(prefix: str, config: AnyConfig, values: Mapping[str, Any]) -> AnyConfig:
    """A part of a configuration with those of the values that are its own."""
    own = {}
    for name, field, _ in parameters_of(config):
        full = name if _is_shared(field) else f'{prefix}.{name}'
        if full in values:
            own[name] = values[full]
    try:
        return with_values(config, own)
    except ConfigError as error:
        raise ConfigError(f'{prefix}.{error}') from error


def _shared(default: Any, description: str, **limits: Any) -> Any:
    """Declare a field that has its own name in every part; limits: as of `parameter`."""
    field = parameter(default, description, **limits)
    return dataclasses.field(default=field.default, metadata={**field.metadata, 'shared': True})


def _is_shared(field: 'dataclasses.Field[Any]') -> bool:
    return bool(field.metadata.get('shared'))


def _require_kind(name: str, value: object, kind: type[Config]) -> None:
    if not isinstance(value, kind):
        raise ConfigError(f'{name} = {quoted(value)}: expected {with_article(kind.__name__)}')


def _check(field: 'dataclasses.Field[Any]', value: Any) -> None:
    low, high, choices = (field.metadata[key] for key in ('low', 'high', 'choices'))
    if not _same_type(value, field.default):
        expected = type(field.default).__name__
        raise ConfigError(f'{field.name} = {quoted(value)}: expected {with_article(expected)}')
    if choices is not None and value not in choices:
        raise ConfigError(f'{field.name} = {quoted(value)}: expected one of {", ".join(choices)}')
    require_number(field.name, value, low, high)


def require_number(name: str, value: Any, low: float | None, high: float | None) -> None:
    """Raise ConfigError unless a number is finite and in its range; other types are not checked.

    low, high: inclusive bounds; None: no more than the numbers that any parameter can have.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    if not _is_finite(value):
        raise ConfigError(f'{name} = {quoted(value)}: expected a finite number')
    if (low is not None and value < low) or (high is not None and value > high):
        raise ConfigError(f'{name} = {quoted(value)}: expected {_interval(low, high)}')
    if isinstance(value, float) and abs(value) > _MAX_ABSOLUTE:
        raise ConfigError(
            f'{name} = {quoted(value)}: expected {_interval(-_MAX_ABSOLUTE, _MAX_ABSOLUTE)}'
        )


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
