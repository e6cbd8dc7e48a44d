"""The package as colcon, rosdep and `ros2 run` see it."""

import ast
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from ament_index_python import get_package_prefix, get_package_share_directory

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'thinmap_ros'
MODULES = [path for room in ('nodes', 'tools') for path in (PACKAGE / room).glob('*.py')]
PROGRAMS = sorted(path.stem for path in MODULES if 'def main(' in path.read_text())
TOOLS = sorted(
    path.stem for path in (PACKAGE / 'tools').glob('*.py') if 'ArgumentParser(' in path.read_text()
)
# rosdep keys of what is imported under another name.
KEYS = {
    'PIL': 'python3-pil',
    'yaml': 'python3-yaml',
    'rosbags': 'python3-rosbags-pip',
    'mcap': 'python3-mcap-pip',
    'cv2': 'python3-opencv',
}
# Optional, and named in setup.py as extras.
EXTRAS = {'rerun', 'dask', 'distributed'}


@pytest.mark.parametrize(
    ('folder', 'tags'),
    [
        ('thinmap_ros', ('depend', 'exec_depend')),
        ('test', ('depend', 'exec_depend', 'test_depend')),
    ],
)
def test_every_import_has_its_key_in_package_xml(folder, tags):
    wanted, own = set(), {'thinmap_ros'} | {path.stem for path in (ROOT / 'test').rglob('*.py')}
    own |= {'benchmarks'} if folder == 'test' else set()
    for path in (ROOT / folder).rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [n.name for n in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) else []
            wanted |= {name.split('.')[0] for name in names}
    wanted -= set(sys.stdlib_module_names) | own | EXTRAS
    tree = ElementTree.parse(ROOT / 'package.xml')
    keys = {element.text for tag in tags for element in tree.iter(tag)}
    missing = {
        name
        for name in wanted
        if KEYS.get(name, name) not in keys and f'python3-{name}' not in keys
    }
    assert not missing


@pytest.mark.parametrize('name', PROGRAMS)
def test_every_program_is_installed_where_ros2_run_looks(name):
    assert (Path(get_package_prefix('thinmap_ros')) / 'lib' / 'thinmap_ros' / name).exists()


@pytest.mark.parametrize('folder', ['config', 'worlds'])
def test_files_for_users_are_installed(folder):
    installed = Path(get_package_share_directory('thinmap_ros')) / folder
    assert sorted(p.name for p in installed.iterdir()) == sorted(
        p.name for p in (ROOT / folder).iterdir()
    )


@pytest.mark.parametrize('name', TOOLS)
def test_every_tool_has_help(name):
    command = [sys.executable, '-m', f'thinmap_ros.tools.{name}', '--help']
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert 'usage' in done.stdout


def test_versions_agree():
    manifests = [ROOT / 'package.xml', ROOT / 'thinmap_msgs' / 'package.xml']
    (version,) = {ElementTree.parse(path).find('version').text for path in manifests}
    assert f"version='{version}'" in (ROOT / 'setup.py').read_text()
