"""The layers and concepts of docs/development/architecture.md, and the style of the sources."""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import networkx
import pytest

from thinmap_ros.__main__ import PROGRAMS

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'thinmap_ros'
PAGE = ROOT / 'docs' / 'development' / 'architecture.md'


def read_rooms():
    """Allowed imports of each package: itself, those in its row of the page, and all of theirs."""
    layers = PAGE.read_text().partition('## Concepts')[0]
    rows = re.findall(r'^\| `([\w.]+)` \| .+ \|(.*)\|$', layers, re.MULTILINE)
    direct = {name: set(re.findall('`([^`]+)`', cell)) for name, cell in rows}
    core = {name for name in direct if name.startswith('core')}

    def allowed(name):
        below = direct[name] | (core if 'core' in direct[name] and name not in core else set())
        return {name}.union(*(allowed(other) for other in below))

    return {name: allowed(name) for name in direct}


ROOMS = read_rooms()
WITH_LIBRARIES = {'files', 'logs', 'view', 'kernels', 'ros', 'nodes'}

OUTSIDE = {
    'rclpy',
    'rosbags',
    'mcap',
    'rerun',
    'matplotlib',
    'ament_index_python',
    'PIL',
    'yaml',
    'networkx',
}
CORE_LIBRARIES = {'numpy', 'numba', 'scipy'}
# Files, clocks, threads and processes.
NOT_IN_CORE = {
    'asyncio',
    'concurrent',
    'io',
    'multiprocessing',
    'os',
    'queue',
    'random',
    'shutil',
    'subprocess',
    'tempfile',
    'threading',
    'time',
}
SOURCES = sorted(PACKAGE.rglob('*.py'))


def room_of(module):
    """Package of a dotted module below thinmap_ros."""
    parts = module.split('.')
    if parts[0] == 'core' and len(parts) > 1 and (PACKAGE / 'core' / parts[1]).is_dir():
        return f'core.{parts[1]}'
    return parts[0]


def imports(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, 'relative import'
            # `from package import module` is an import of the module if it exists.
            for name in node.names:
                path = PACKAGE.parent.joinpath(*node.module.split('.'), name.name)
                is_module = path.is_dir() or path.with_suffix('.py').exists()
                yield f'{node.module}.{name.name}' if is_module else node.module


@pytest.mark.parametrize('path', SOURCES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_imports_go_through_the_doors(path):
    module = '.'.join(path.relative_to(PACKAGE).with_suffix('').parts)
    room = room_of(module)
    if room == '__init__':
        return
    for imported in imports(ast.parse(path.read_text())):
        top = imported.split('.')[0]
        if top == 'thinmap_ros':
            other = room_of(imported.removeprefix('thinmap_ros.').removeprefix('thinmap_ros'))
            assert other in ROOMS[room] or not other, f'{module} imports {imported}'
        elif room not in WITH_LIBRARIES:
            assert top not in OUTSIDE and not top.endswith('_msgs'), f'{module} imports {imported}'
        if room.startswith('core') and top != 'thinmap_ros':
            allowed = CORE_LIBRARIES | (sys.stdlib_module_names - NOT_IN_CORE)
            assert top in allowed, f'{module} imports {imported}'


def test_every_room_is_known():
    rooms = {room_of('.'.join(path.relative_to(PACKAGE).with_suffix('').parts)) for path in SOURCES}
    assert rooms <= set(ROOMS) | {'__init__'}


@pytest.mark.programs
def test_core_imports_with_everything_else_blocked():
    modules = [
        'thinmap_ros.' + '.'.join(p.relative_to(PACKAGE).with_suffix('').parts)
        for p in SOURCES
        if p.is_relative_to(PACKAGE / 'core') and p.name != '__init__.py'
    ]
    code = f"""
import importlib, sys
class Wall:
    def find_spec(self, name, path=None, target=None):
        top = name.split('.')[0]
        if top in {sorted(OUTSIDE)!r} or top.endswith('_msgs'):
            raise ImportError(f'blocked: {{name}}')
sys.meta_path.insert(0, Wall())
for module in {modules!r}:
    importlib.import_module(module)
"""
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, cwd=PACKAGE.parent
    )
    assert done.returncode == 0, done.stderr


def imported_first(path):
    """Modules that a file imports when it is imported itself, not within functions."""
    tree = ast.parse(path.read_text())
    body = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    return imports(ast.Module(body, []))


def test_programs_without_ros_import_none_of_it():
    arrows = networkx.DiGraph(
        (f'thinmap_ros.{name}', imported)
        for name, path in MODULES.items()
        for imported in imported_first(path)
    )
    for name, program in PROGRAMS.items():
        reached = networkx.descendants(arrows, f'thinmap_ros.{program.module}')
        ros = {each for each in reached if each.split('.')[0].endswith(('rclpy', '_msgs'))}
        assert not ros, f'{name} imports {sorted(ros)}'


def packed(tree):
    """Lines of assignments of several values to several names, but swaps."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Tuple):
            continue
        target = node.targets[0]
        if not isinstance(target, ast.Tuple):
            continue
        targets = {ast.unparse(element) for element in target.elts}
        values = {ast.unparse(element) for element in node.value.elts}
        if not targets & values:
            yield node.lineno


def test_packed_assignments_are_found():
    assert list(packed(ast.parse('a, b = 1, 2'))) == [1]
    assert not list(packed(ast.parse('a, b = b, a\nc, d = f()\ne = 1, 2')))


def test_one_statement_a_line():
    found = [
        f'{path.relative_to(ROOT)}:{line}'
        for folder in ('thinmap_ros', 'benchmarks', 'examples', 'test', 'scripts')
        for path in sorted((ROOT / folder).rglob('*.py'))
        for line in packed(ast.parse(path.read_text()))
    ]
    assert not found


def test_a_folder_names_its_one_concept():
    """In one sentence: the first line of the docstring of its package."""
    for path in PACKAGE.rglob('__init__.py'):
        docstring = ast.get_docstring(ast.parse(path.read_text())) or ''
        assert re.fullmatch(r'[^.\n]+\.', docstring.split('\n')[0]), path


def test_no_module_imports_itself_through_others():
    """Neither within functions, nor for type checkers alone."""
    modules = {
        '.'.join(path.relative_to(ROOT).with_suffix('').parts).removesuffix('.__init__'): path
        for path in SOURCES
    }
    # The package itself names its public interface, whose modules it imports when they are used.
    arrows = networkx.DiGraph(
        (name, imported)
        for name, path in modules.items()
        for imported in imports(ast.parse(path.read_text()))
        if PACKAGE.name not in (name, imported)
    )
    assert list(networkx.simple_cycles(arrows)) == []


def concepts():
    """Rows of the concepts of the core: file or folder, and what it must not know."""
    rows = re.findall(
        r'^\| `([\w.]+)` \| [^|]+ \| [^|]+ \| ([^|]+) \|$', PAGE.read_text(), re.MULTILINE
    )
    return {f'core.{name}': re.findall('`([^`]+)`', cell) for name, cell in rows}


CONCEPTS = concepts()
MODULES = {
    '.'.join(path.relative_to(PACKAGE).with_suffix('').parts): path
    for path in SOURCES
    if path.name != '__init__.py'
}
CORE = {name for name in MODULES if name.startswith('core.')}


def is_part(module, name):
    """Whether a module is a file or in the folder of a name."""
    return module == name or module.startswith(f'{name}.')


@cache
def reached_by_core():
    """Modules of the core that each of them imports, also through others."""
    arrows = networkx.DiGraph()
    arrows.add_nodes_from(CORE)
    for name in CORE:
        for imported in imports(ast.parse(MODULES[name].read_text())):
            if imported.removeprefix('thinmap_ros.') in CORE:
                arrows.add_edge(name, imported.removeprefix('thinmap_ros.'))
    return {name: networkx.descendants(arrows, name) for name in CORE}


def test_each_file_of_the_core_is_one_concept_of_the_table():
    owners = {module: [name for name in CONCEPTS if is_part(module, name)] for module in CORE}
    assert {module: found for module, found in owners.items() if len(found) != 1} == {}
    assert [name for name in CONCEPTS if not any(is_part(m, name) for m in CORE)] == []


@pytest.mark.parametrize('name', CONCEPTS)
def test_a_concept_does_not_import_what_it_must_not_know(name):
    reached = reached_by_core()
    known = {
        other
        for module in CORE
        if is_part(module, name)
        for other in reached[module]
        if not is_part(other, name)
    }
    for unknown in CONCEPTS[name]:
        assert any(is_part(module, unknown) for module in CORE), f'{unknown}: no such file'
        assert [other for other in known if is_part(other, unknown)] == []


MIN_STATEMENTS = 40


def small_files():
    """Files below the limit that the page gives a reason for, without their suffix."""
    section = PAGE.read_text().partition('## Small files')[2]
    rows = re.findall(r'^\| (`.+`) \| \w', section, re.MULTILINE)
    return {name for cell in rows for name in re.findall('`([^`]+)`', cell)}


def test_a_file_has_enough_of_a_concept_or_a_reason():
    """Imports count as statements, as in any measure of size."""
    counts = {
        path.relative_to(PACKAGE).with_suffix('').as_posix(): sum(
            isinstance(node, ast.stmt) for node in ast.walk(ast.parse(path.read_text()))
        )
        for path in SOURCES
        if path.name != '__init__.py'
    }
    small = {name for name, count in counts.items() if count < MIN_STATEMENTS}
    assert small == small_files()
