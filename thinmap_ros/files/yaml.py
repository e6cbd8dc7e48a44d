"""Reads YAML of any origin, within limits that are checked before objects are constructed.

A file of a few hundred bytes can describe billions of members by repetition (anchors and aliases,
merge keys). No file of this project needs them, so they are rejected. The limits are far above any
world: 4 MiB, 100,000 nodes (values, lists and mappings), 20 levels, numbers of 100 characters.

Numbers are those of yaml-cpp, which reads the same files in ROS: `1e-1`, `-.5` and `1.e2` are
numbers, `010` is ten, and `1:30` and `1_000` are texts. YAML 1.1, which PyYAML follows, says
otherwise.
"""

import re
from pathlib import Path
from typing import Any, ClassVar

import yaml

from thinmap_ros.core.errors import InputError, one_line_reason, quoted
from thinmap_ros.files.atomic import read_text
from thinmap_ros.files.limits import FILES

_MERGE_TAG = 'tag:yaml.org,2002:merge'
_INTEGER_TAG = 'tag:yaml.org,2002:int'
_FLOAT_TAG = 'tag:yaml.org,2002:float'
_NUMBER_TAGS = (_INTEGER_TAG, _FLOAT_TAG)
_DECIMAL = re.compile(r'[-+]?[0-9]+\Z')
_INTEGER = re.compile(r'(?:[-+]?[0-9]+|0x[0-9a-fA-F]+)\Z')
_FLOAT = re.compile(
    r'(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?'
    r'|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))\Z'
)
_TRUE = ('y', 'yes', 'true', 'on')
_FALSE = ('n', 'no', 'false', 'off')


def parse_yaml(text: str) -> object:
    """Parse a YAML text: mappings, lists, texts, numbers, booleans, dates or nothing.

    Raises InputError, without a file name, if it is no YAML, or exceeds the limits.
    """
    return _parse(text, _BoundedLoader)


def read_mapping(path: Path, expected: str) -> dict[str, Any]:
    """Read a mapping. Raises InputError with the file name and the expectation."""
    return _read_mapping(path, expected, _BoundedLoader)


def read_texts(path: Path, expected: str) -> dict[str, Any]:
    """Read a mapping, as `read_mapping`; each value is the text that is written, or a list of such.

    The reader of a value decides on its type, as in yaml-cpp: `number_of`, `boolean_of`.
    """
    return _read_mapping(path, expected, _TextLoader)


def number_of(value: object) -> float:
    """Number that yaml-cpp reads of a text. Raises ValueError where it reads none."""
    if not isinstance(value, str) or not _FLOAT.match(value):
        raise ValueError(f'{quoted(value)}: expected a number')
    is_special = value.endswith(('f', 'F', 'n', 'N'))
    return float(value.replace('.', '') if is_special else value)


def boolean_of(value: object) -> bool:
    """Boolean that yaml-cpp reads of a text, or 0 or 1. Raises ValueError where it is neither."""
    text = value if isinstance(value, str) else ''
    if _DECIMAL.match(text) and int(text) in (0, 1):
        return bool(int(text))
    name = text.lower()
    if name in (*_TRUE, *_FALSE) and text in (name, name.upper(), name.capitalize()):
        return name in _TRUE
    raise ValueError(f'{quoted(value)}: expected 0, 1, true or false')


def _parse(text: str, loader: type['_BoundedLoader']) -> object:
    if len(text) > FILES.yaml_bytes:
        raise _YamlError(f'{len(text)} characters: expected at most {FILES.yaml_bytes}')
    try:
        return yaml.load(text, Loader=loader)
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        # ValueError, OverflowError: a date such as 2001-99-99, or 1e999 minutes.
        raise _YamlError(one_line_reason(error)) from error


def _read_mapping(path: Path, expected: str, loader: type['_BoundedLoader']) -> dict[str, Any]:
    try:
        content = _parse(read_text(path, FILES.yaml_bytes), loader)
    except _YamlError as error:
        raise InputError(f'{path}: {error}: expected {expected}') from error
    if not isinstance(content, dict):
        raise InputError(f'{path}: expected {expected}')
    for key in content:
        if not isinstance(key, str):
            raise InputError(f'{path}: key {quoted(key)}: expected a name; {expected}')
    return content


class _YamlError(InputError):
    """Error in a YAML text, without the file name."""


class _BoundedLoader(yaml.SafeLoader):
    """Counts nodes while parsing; objects are constructed after the last one."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._nodes = 0
        self._level = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose the next node. Raises _YamlError beyond the limits, or at an alias."""
        event = self.peek_event()
        self._reject_aliases(event)
        self._nodes += 1
        self._level += 1
        if self._nodes > FILES.yaml_nodes:
            expected = f'expected at most {FILES.yaml_nodes} values, lists and mappings'
            raise _YamlError(f'{_at(event)}: {expected}')
        if self._level > FILES.yaml_levels:
            raise _YamlError(f'{_at(event)}: expected at most {FILES.yaml_levels} levels')
        node = super().compose_node(parent, index)
        self._level -= 1
        self._reject_long_number(node, event)
        return node

    def _reject_aliases(self, event: yaml.Event) -> None:
        name = getattr(event, 'anchor', None)
        if name is not None:
            expected = 'expected no anchors and aliases (& and *)'
            raise _YamlError(f'{_at(event)}: {quoted(name)}: {expected}')

    def _reject_long_number(self, node: yaml.Node | None, event: yaml.Event) -> None:
        if not isinstance(node, yaml.ScalarNode):
            return
        if node.tag == _MERGE_TAG:
            raise _YamlError(f'{_at(event)}: <<: expected no merge keys')
        if node.tag in _NUMBER_TAGS and len(node.value) > FILES.digits:
            expected = f'expected at most {FILES.digits}'
            size = len(node.value)
            raise _YamlError(f'{_at(event)}: a number of {size} characters: {expected}')

    def construct_integer(self, node: yaml.ScalarNode) -> int:
        """An integer, decimal or hexadecimal."""
        text = str(self.construct_scalar(node))
        return int(text, 16 if text.startswith('0x') else 10)


_BoundedLoader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in _NUMBER_TAGS]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_BoundedLoader.add_implicit_resolver(_INTEGER_TAG, _INTEGER, list('-+0123456789'))
_BoundedLoader.add_implicit_resolver(_FLOAT_TAG, _FLOAT, list('-+.0123456789'))
_BoundedLoader.add_constructor(_INTEGER_TAG, _BoundedLoader.construct_integer)


class _TextLoader(_BoundedLoader):
    """Leaves scalars as they are written, whatever their tags."""

    yaml_constructors: ClassVar[dict[Any, Any]] = {}
    yaml_multi_constructors: ClassVar[dict[Any, Any]] = {}


# Merge keys are found, and rejected.
_TextLoader.yaml_implicit_resolvers = {'<': yaml.SafeLoader.yaml_implicit_resolvers['<']}


def _at(event: yaml.Event) -> str:
    """Line and column of an event, from 1."""
    mark = event.start_mark
    return 'somewhere' if mark is None else f'line {mark.line + 1}, column {mark.column + 1}'
