"""Allowed imports between packages (docs/development/architecture.md), and limits of the style."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import networkx
import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'thinmap_ros'
PAGE = ROOT / 'docs' / 'development' / 'architecture.md'


def read_rooms():
    """Allowed imports of each package: itself, those in its row of the page, and all of theirs."""
    rows = re.findall(r'^\| `([\w.]+)` \| .+ \|(.*)\|$', PAGE.read_text(), re.MULTILINE)
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


MAX_ATTRIBUTES = 12
# Until it is rebuilt.
LARGE_CLASSES = {'GlobalLocalization'}


def attributes(node):
    """Names of the attributes that the methods of a class assign to self."""
    return {
        target.attr
        for target in ast.walk(node)
        if isinstance(target, ast.Attribute)
        and isinstance(target.ctx, ast.Store)
        and isinstance(target.value, ast.Name)
        and target.value.id == 'self'
    }


def test_attributes_are_counted_once_and_in_every_form_of_assignment():
    source = 'class A:\n def f(self):\n  self.a, self.b = 1, 2\n  self.c: int = 3\n  self.a += 1'
    assert attributes(ast.parse(source)) == {'a', 'b', 'c'}


def test_a_class_has_few_attributes():
    counts = {
        f'{path.relative_to(PACKAGE)}: {node.name}': len(attributes(node))
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef) and node.name not in LARGE_CLASSES
    }
    assert not {name: count for name, count in counts.items() if count > MAX_ATTRIBUTES}
