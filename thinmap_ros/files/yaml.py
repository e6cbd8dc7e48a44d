"""Reads YAML of any origin, within limits that are checked before objects are constructed.

A file of a few hundred bytes can describe billions of members by repetition (anchors and aliases,
merge keys). No file of this project needs them, so they are rejected. The limits are far above any
world: 4 MiB, 100,000 nodes (values, lists and mappings), 20 levels, numbers of 100 characters.
"""

from pathlib import Path
from typing import Any

import yaml

from thinmap_ros.core.errors import InputError, one_line_reason, quoted
from thinmap_ros.files.atomic import read_text
from thinmap_ros.files.limits import FILES

_MERGE_TAG = 'tag:yaml.org,2002:merge'
_NUMBER_TAGS = ('tag:yaml.org,2002:int', 'tag:yaml.org,2002:float')


def load_yaml(path: Path) -> object:
    """Read a YAML file: mappings, lists, texts, numbers, booleans, dates or nothing.

    Raises InputError with the file name if it is no YAML, or exceeds the limits.
    """
    try:
        return parse_yaml(read_text(path, FILES.yaml_bytes))
    except _YamlError as error:
        raise InputError(f'{path}: {error}') from error


def parse_yaml(text: str) -> object:
    """Parse a YAML text, as `load_yaml`. Raises InputError as it does."""
    if len(text) > FILES.yaml_bytes:
        raise _YamlError(f'{len(text)} characters: expected at most {FILES.yaml_bytes}')
    try:
        return yaml.load(text, Loader=_BoundedLoader)
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        # ValueError, OverflowError: a date such as 2001-99-99, or 1e999 minutes.
        raise _YamlError(one_line_reason(error)) from error


def read_mapping(path: Path, expected: str) -> dict[str, Any]:
    """Read a mapping. Raises InputError with the file name and the expectation."""
    try:
        content = parse_yaml(read_text(path, FILES.yaml_bytes))
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


def _at(event: yaml.Event) -> str:
    """Line and column of an event, from 1."""
    mark = event.start_mark
    return 'somewhere' if mark is None else f'line {mark.line + 1}, column {mark.column + 1}'
