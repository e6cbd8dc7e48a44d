"""What a file of this project imports, read from its text."""

import ast
from collections.abc import Iterator
from pathlib import Path


def imported(root: Path, source: Path) -> Iterator[Path]:
    """Modules and packages of the project, and helpers of its tests, that a file imports."""
    for node in ast.walk(ast.parse(source.read_bytes())):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield from _files(root, alias.name)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from _files(root, node.module)
            for alias in node.names:
                yield from _files(root, f'{node.module}.{alias.name}')


def _files(root: Path, dotted: str) -> Iterator[Path]:
    for base in (root, root / 'test'):
        path = base.joinpath(*dotted.split('.'))
        for file in (path.with_suffix('.py'), path / '__init__.py'):
            if file.exists():
                yield file
