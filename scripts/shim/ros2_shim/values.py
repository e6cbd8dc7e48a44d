"""Types by name, and conversion of messages from and to YAML."""

import array
import importlib
from typing import Any

import numpy as np
import yaml
from rosidl_parser.definition import (
    FLOATING_POINT_TYPES,
    AbstractNestedType,
    Array,
    BasicType,
    BoundedSequence,
    NamespacedType,
)

from ros2_shim.verb import ShimError


def type_named(name: str, kind: str) -> Any:
    """Class of a type by its name; kind: msg, srv or action."""
    word = {'msg': 'message', 'srv': 'service'}.get(kind, kind)
    try:
        package, *middle, last = name.split('/')
        if middle not in ([], [kind]):
            raise ValueError(name)
        return getattr(importlib.import_module(f'{package}.{kind}'), last)
    except (AttributeError, ImportError, TypeError, ValueError):
        raise ShimError(
            f"The passed {word} type is invalid: '{name}', "
            f'expected PACKAGE/{kind}/NAME of an installed package'
        ) from None


def read(kind: Any, text: str) -> Any:
    """Message of a class with the values of fields, by name, in YAML."""
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        reason = getattr(error, 'problem', None) or 'no YAML'
        raise ShimError(f"The passed value is not YAML: '{text}': {reason}") from None
    if not isinstance(values, dict | None):
        raise ShimError(
            f"The passed value needs to be a dictionary in YAML format: '{text}', "
            "expected as in '{name: value}'"
        )
    return _message(kind, values or {})


def _message(kind: Any, values: Any) -> Any:
    name = kind.__name__
    if not isinstance(values, dict):
        raise ShimError(f"Failed to populate field: {name}: '{values}', expected a dictionary")
    message = kind(check_fields=True)
    fields = kind.get_fields_and_field_types()
    types = dict(zip(fields, kind.SLOT_TYPES, strict=True))
    for field, value in values.items():
        if field not in fields:
            has = ', '.join(fields) or 'none'
            raise ShimError(f"Failed to populate field: {name} has no '{field}'; it has {has}")
        try:
            setattr(message, field, _converted(types[field], value))
        except (AssertionError, TypeError, ValueError, OverflowError):
            raise ShimError(
                f"Failed to populate field: {name}.{field}: '{value}', expected {fields[field]}"
            ) from None
    return message


def _converted(kind: Any, value: Any) -> Any:
    """A value of YAML as the setter of a message takes it, which checks it."""
    if isinstance(kind, AbstractNestedType):
        if not isinstance(value, list):
            raise ValueError(value)
        return [_converted(kind.value_type, item) for item in value]
    if isinstance(kind, NamespacedType):
        return _message(type_named('/'.join(kind.namespaced_name()), 'msg'), value)
    if not isinstance(kind, BasicType):
        # YAML reads `name: 5` as a number: converted to a text.
        return str(value) if isinstance(value, str | int | float) else value
    if isinstance(value, bool) is not (kind.typename == 'boolean'):
        raise ValueError(value)
    if kind.typename == 'octet':
        return bytes([value])
    is_whole = kind.typename in FLOATING_POINT_TYPES and isinstance(value, int)
    return float(value) if is_whole else value


def to_yaml(
    message: Any, longest: int | None = None, no_arr: bool = False, flow: bool = False
) -> str:
    """YAML text of a message; sequences and texts are truncated after `longest` elements."""
    return yaml.dump(
        _plain(message, longest, no_arr),
        allow_unicode=True,
        width=float('inf'),
        default_flow_style=flow,
        sort_keys=False,
    )


def _plain(value: Any, longest: int | None, no_arr: bool) -> Any:
    """Dictionaries, in the order of the fields, lists, numbers and texts of a message."""
    if hasattr(value, 'SLOT_TYPES'):
        return _plain_fields(value, longest, no_arr)
    if isinstance(value, bytes):
        value = value.decode('latin-1')
    if isinstance(value, str):
        is_cut = longest is not None and len(value) > longest
        return f'{value[:longest]}...' if is_cut else value
    if isinstance(value, list | tuple | array.array | np.ndarray):
        rest = ['...'] if longest is not None and len(value) > longest else []
        return [_plain(item, longest, no_arr) for item in value[:longest]] + rest
    return value.item() if isinstance(value, np.generic) else value


def _plain_fields(message: Any, longest: int | None, no_arr: bool) -> dict[str, Any]:
    fields = {}
    for field, kind in zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True):
        value = getattr(message, field)
        is_hidden = no_arr and isinstance(kind, AbstractNestedType)
        fields[field] = _summary(kind, value) if is_hidden else _plain(value, longest, no_arr)
    return fields


def _summary(kind: AbstractNestedType, value: Any) -> str:
    """Placeholder of a sequence that is not shown."""
    name = getattr(kind.value_type, 'typename', 'string')
    if isinstance(kind.value_type, NamespacedType):
        name = '/'.join(kind.value_type.namespaced_name())
    if isinstance(kind, Array):
        return f'<array type: {name}[{kind.size}]>'
    limit = f'[{kind.maximum_size}]' if isinstance(kind, BoundedSequence) else ''
    return f'<sequence type: {name}{limit}, length: {len(value)}>'
