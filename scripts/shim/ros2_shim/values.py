"""Types by name, and conversion of messages from and to YAML."""

import array
import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
import yaml
from rosidl_parser.definition import (
    AbstractNestedType,
    Array,
    BasicType,
    BoundedSequence,
    NamespacedType,
)

from ros2_shim.verbs import ShimError

Now = Callable[[], Any]
_INTEGERS = ('int', 'uint', 'byte', 'octet', 'char')


def type_named(name: str, kind: str) -> Any:
    """Class of a type by its name; kind: msg, srv or action."""
    word = {'msg': 'message', 'srv': 'service'}.get(kind, kind)
    parts = name.split('/')
    if len(parts) == 2:
        parts.insert(1, kind)
    try:
        package, middle, last = parts
        if middle != kind:
            raise ValueError(name)
        return getattr(importlib.import_module(f'{package}.{kind}'), last)
    except (AttributeError, ImportError, ValueError):
        raise ShimError(
            f"The passed {word} type is invalid: '{name}', "
            f'expected PACKAGE/{kind}/NAME of an installed package'
        ) from None


def mapping(text: str) -> dict[str, Any]:
    """Parse the values of fields, by name, from YAML."""
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        reason = getattr(error, 'problem', None) or 'no YAML'
        raise ShimError(f"The passed value is not YAML: '{text}': {reason}") from None
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ShimError(
            f"The passed value needs to be a dictionary in YAML format: '{text}', "
            "expected as in '{name: value}'"
        )
    return values


def fill(message: Any, values: Any, now: Now | None = None) -> Any:
    """Set fields of a message.

    With `now`, a header may be `auto` and a time `now`.
    """
    name = type(message).__name__
    if not isinstance(values, dict):
        raise ShimError(f"Failed to populate field: {name}: '{values}', expected a dictionary")
    types = dict(zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True))
    for field, value in values.items():
        if field not in types:
            has = ', '.join(types) or 'none'
            raise ShimError(f"Failed to populate field: {name} has no '{field}'; it has {has}")
        try:
            setattr(message, field, _converted(getattr(message, field), types[field], value, now))
        except (AssertionError, TypeError, ValueError, OverflowError):
            kind = message.get_fields_and_field_types()[field]
            raise ShimError(
                f"Failed to populate field: {name}.{field}: '{value}', expected {kind}"
            ) from None
    return message


def _converted(present: Any, kind: Any, value: Any, now: Now | None) -> Any:
    if isinstance(kind, AbstractNestedType):
        return _sequence(present, kind, value, now)
    if isinstance(kind, NamespacedType):
        return _message(present, value, now)
    return _scalar(kind, value)


def _message(present: Any, value: Any, now: Now | None) -> Any:
    name = type(present).__name__
    if now is not None and name == 'Time' and value == 'now':
        return now()
    if now is not None and name == 'Header' and value == 'auto':
        return type(present)(stamp=now())
    return fill(type(present)(), value, now)


def _sequence(present: Any, kind: Any, value: Any, now: Now | None) -> Any:
    if not isinstance(value, list):
        raise ValueError(value)
    if isinstance(kind.value_type, NamespacedType):
        element = type_named('/'.join(kind.value_type.namespaced_name()), 'msg')
        return [_message(element(), item, now) for item in value]
    items = [_scalar(kind.value_type, item) for item in value]
    if isinstance(present, array.array):
        return array.array(present.typecode, items)
    if isinstance(present, np.ndarray):
        return np.array(items, dtype=present.dtype)
    return items


def _scalar(kind: Any, value: Any) -> Any:
    if not isinstance(kind, BasicType):
        # YAML reads `name: 5` as a number: converted to a text.
        if isinstance(value, str | int | float):
            return str(value)
        raise ValueError(value)
    if kind.typename == 'boolean':
        if not isinstance(value, bool):
            raise ValueError(value)
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(value)
    if kind.typename == 'octet':
        return bytes([value])  # type: ignore[list-item]
    if kind.typename.startswith(_INTEGERS):
        if not isinstance(value, int):
            raise ValueError(value)
        return value
    return float(value)


def to_yaml(
    message: Any,
    longest: int | None = None,
    no_arr: bool = False,
    no_str: bool = False,
    flow: bool = False,
) -> str:
    """YAML text of a message; sequences and texts are truncated after `longest` elements."""
    return yaml.dump(
        plain(message, longest, no_arr, no_str),
        allow_unicode=True,
        width=float('inf'),
        default_flow_style=flow,
        sort_keys=False,
    )


def plain(
    message: Any, longest: int | None = None, no_arr: bool = False, no_str: bool = False
) -> dict[str, Any]:
    """Convert a message to dictionaries, lists, numbers and texts, in the order of its fields."""
    result: dict[str, Any] = {}
    for field, kind in zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True):
        value = getattr(message, field)
        if no_arr and isinstance(kind, AbstractNestedType):
            result[field] = _told(kind, value)
        else:
            result[field] = _plain_value(value, longest, no_arr, no_str)
    return result


def _plain_value(value: Any, longest: int | None, no_arr: bool, no_str: bool) -> Any:
    if isinstance(value, bytes):
        return _cut(''.join(chr(c) for c in value), longest)
    if isinstance(value, str):
        return f'<string length: <{len(value)}>>' if no_str else _cut(value, longest)
    if isinstance(value, list | tuple | array.array | np.ndarray):
        rest = ['...'] if longest is not None and len(value) > longest else []
        return [_plain_value(v, longest, no_arr, no_str) for v in value[:longest]] + rest
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, bool | int | float):
        return value
    return plain(value, longest, no_arr, no_str)


def _cut(text: str, longest: int | None) -> str:
    return text if longest is None or len(text) <= longest else f'{text[:longest]}...'


def _told(kind: AbstractNestedType, value: Any) -> str:
    """Placeholder of a sequence that is not shown."""
    element = kind.value_type
    if isinstance(element, NamespacedType):
        name = '/'.join(element.namespaced_name())
    else:
        name = element.typename if isinstance(element, BasicType) else 'string'
    if isinstance(kind, Array):
        return f'<array type: {name}[{kind.size}]>'
    if isinstance(kind, BoundedSequence):
        return f'<sequence type: {name}[{kind.maximum_size}], length: {len(value)}>'
    return f'<sequence type: {name}, length: {len(value)}>'
