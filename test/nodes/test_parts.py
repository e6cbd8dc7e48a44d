"""Parts of nodes: their import starts nothing, so that tests need no graph."""

import ast
import importlib
from pathlib import Path

import pytest

from thinmap_ros.nodes import parts

DEFINITIONS = (
    ast.Import,
    ast.ImportFrom,
    ast.Assign,
    ast.AnnAssign,
    ast.FunctionDef,
    ast.ClassDef,
)
PARTS = sorted(path.stem for path in Path(parts.__path__[0]).glob('[!_]*.py'))


@pytest.mark.parametrize('name', PARTS)
def test_a_part_only_defines(name):
    module = importlib.import_module(f'thinmap_ros.nodes.parts.{name}')
    about, *rest = ast.parse(Path(module.__file__).read_text()).body
    assert isinstance(about, ast.Expr)
    assert [each for each in rest if not isinstance(each, DEFINITIONS)] == []
