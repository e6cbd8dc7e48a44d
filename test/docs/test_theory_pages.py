"""The theory pages name functions and modules that exist, and parameters of the nodes."""

import ast
import re

import pytest
from support.node_list import ROOT

PAGES = sorted((ROOT / 'docs' / 'theory').glob('*.md'))
CORE = ROOT / 'thinmap_ros' / 'core'
_FOLDER = re.compile(r'`thinmap_ros/core/([\w/]*)`')
_QUOTED = re.compile(r'`([^`]+)`')


def names_in(path):
    """Functions, classes, methods and fields that a module defines, constants too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            names = [part.name for part in node.body if isinstance(part, ast.FunctionDef)]
            found |= {f'{node.name}.{name}' for name in names}
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
    return found


def rows(text):
    """Names in the second column of tables with modules in the third, and these modules."""
    for line in text.splitlines():
        cells = line.strip('| ').split(' | ')
        modules = [name for name in _QUOTED.findall(cells[-1]) if name.endswith('.py')]
        if line.startswith('|') and modules:
            yield _QUOTED.findall(cells[1]), modules


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.stem)
def test_functions_are_in_the_modules_that_the_page_names(page):
    text = page.read_text()
    folders = {CORE} | {CORE / name for name in _FOLDER.findall(text)}
    count = 0
    for names, modules in rows(text):
        paths = [folder / name for name in modules for folder in folders]
        known = set().union(*(names_in(path) for path in paths if path.is_file()))
        assert all(any((folder / name).is_file() for folder in folders) for name in modules), (
            modules
        )
        assert set(names) <= known, (names, modules)
        count += 1
    assert count >= 5


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.stem)
def test_parameters_are_in_the_node_reference(page):
    reference = (ROOT / 'docs' / 'reference' / 'nodes.md').read_text()
    parameters = set(_QUOTED.findall(reference))
    leaves = {name.split('.')[-1] for name in parameters}
    named = {
        name
        for name in _QUOTED.findall(page.read_text())
        if re.search(r'_(m|rad|deg|s|ratio|cost|threshold)$', name)
    }
    assert named <= leaves | parameters, named - leaves - parameters


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.stem)
def test_pictures_and_links_exist(page):
    for target in re.findall(r'\]\(([^)#]+)', page.read_text()):
        assert (page.parent / target).is_file(), target
