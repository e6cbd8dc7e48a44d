"""The package for colcon, rosdep and `ros2 run`."""

import ast
import re
import sys
from importlib.metadata import version
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from ament_index_python import get_package_prefix, get_package_share_directory
from support.forks import forked

from thinmap_ros import __version__

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'thinmap_ros'
MODULES = [path for room in ('nodes', 'tools') for path in (PACKAGE / room).glob('*.py')]
PROGRAMS = sorted(
    path.stem for path in MODULES if re.search(r'^(def )?main\b', path.read_text(), re.MULTILINE)
)
TOOLS = sorted(
    path.stem for path in (PACKAGE / 'tools').glob('*.py') if '\ndef main(' in path.read_text()
)
# rosdep keys of packages that are imported or installed under another name.
KEYS = {
    'PIL': 'python3-pil',
    'pillow': 'python3-pil',
    'yaml': 'python3-yaml',
    'pyyaml': 'python3-yaml',
    'rosbags': 'python3-rosbags-pip',
    'mcap': 'python3-mcap-pip',
    'lz4': 'python3-mcap-pip',  # a dependency of mcap, as zstandard
    'zstandard': 'python3-mcap-pip',
    'segno': 'python3-segno-pip',
    'cv2': 'python3-opencv',
    'opencv-contrib-python-headless': 'python3-opencv',
    'scikit-image': 'python3-skimage',
    'pytest-xdist': None,  # no key; it only runs tests in parallel
    # No keys: the notebook of the tutorials is run with the wheels.
    'ipykernel': None,
    'jupytext': None,
    'nbclient': None,
}
# Keys of rosdistro's rosdep/python.yaml, read in its commit 662921b on 2026-11-22; of two that were
# added or widened to Ubuntu 24.04 later: its pull requests 37795 (rosbags) and 36477 (numba); of
# argcomplete: package.xml of ros2cli.
KNOWN_KEYS = {
    'python3-argcomplete',
    'python3-hypothesis',
    'python3-matplotlib',
    'python3-networkx',
    'python3-numba',
    'python3-numpy',
    'python3-opencv',
    'python3-pil',
    'python3-psutil',
    'python3-pytest',
    'python3-pytest-timeout',
    'python3-rosbags-pip',
    'python3-scipy',
    'python3-skimage',
    'python3-tornado',
    'python3-tqdm',
    'python3-yaml',
}
# Packages of ROS 2 Jazzy itself, from its distribution's list.
KNOWN_PACKAGES = {
    'action_msgs',
    'ament_cmake',
    'ament_index_python',
    'builtin_interfaces',
    'diagnostic_msgs',
    'geometry_msgs',
    'launch',
    'launch_ros',
    'lifecycle_msgs',
    'map_msgs',
    'nav2_msgs',
    'nav_msgs',
    'rcl_interfaces',
    'rclpy',
    'rosgraph_msgs',
    'rosidl_default_generators',
    'rosidl_default_runtime',
    'sensor_msgs',
    'std_msgs',
    'std_srvs',
    'tf2_msgs',
    'unique_identifier_msgs',
    'visualization_msgs',
}
MANIFESTS = [ROOT / 'package.xml', ROOT / 'thinmap_msgs' / 'package.xml']
LOCKS = {
    'lock-3.11.txt': ('python', 'ros', 'test', 'viewer'),
    'lock-3.12.txt': ('python', 'ros', 'test', 'viewer'),
    'lock-system-3.12.txt': ('python', 'test'),
    'lock-docs.txt': ('docs',),
}
# Optional, and named in setup.py as extras.
EXTRAS = {'rerun', 'dask', 'distributed'}
# Tools for building and checking the code, not needed at run time.
BUILDERS = {'colcon-common-extensions', 'catkin-pkg', 'setuptools'}
CHECKERS = {'ruff', 'mypy', 'types-pyyaml', 'types-tqdm', 'scipy-stubs'}


@pytest.mark.parametrize(
    ('folder', 'tags'),
    [
        ('thinmap_ros', ('depend', 'exec_depend')),
        ('test', ('depend', 'exec_depend', 'test_depend')),
    ],
)
def test_every_import_has_its_key_in_package_xml(folder, tags):
    wanted = set()
    own = {'thinmap_ros'} | {path.stem for path in (ROOT / 'test').rglob('*.py')}
    # A test names a helper in another test folder by both parts.
    own |= {path.name for path in (ROOT / 'test').iterdir() if path.is_dir()}
    own |= {'benchmarks', 'fuzz', 'scripts'} if folder == 'test' else set()
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


def test_rosdep_knows_every_key():
    elements = [e for path in MANIFESTS for e in ElementTree.parse(path).iter()]
    keys = {element.text for element in elements if element.tag.endswith('depend')}
    own = yaml.safe_load((ROOT / 'rosdep.yaml').read_text())
    assert keys - KNOWN_KEYS - KNOWN_PACKAGES - own.keys() == {'thinmap_msgs'}, 'ours, built beside'
    assert own.keys() <= keys, 'none that nothing needs'
    for systems in own.values():
        assert systems['ubuntu']['pip']['packages'], "in rosdep's own format"


def names_in(path):
    """Names of requirements, as spelled by the package index, and their pinned versions."""
    lines = [line.partition('#')[0].strip(' \\') for line in path.read_text().splitlines()]
    lines = [line for line in lines if not line.startswith('--hash=')]
    pairs = [line.partition('==') for line in lines if line]
    return {name.partition('[')[0].lower().replace('_', '-'): pinned for name, _, pinned in pairs}


@pytest.mark.parametrize('lock', [*LOCKS, 'uv.txt'])
def test_every_pinned_wheel_has_its_hashes(lock):
    text = (ROOT / 'requirements' / lock).read_text().replace('\\\n', '')
    for line in text.splitlines():
        assert re.fullmatch(r'[\w.-]+(\[\w+\])?==\S+(\s+--hash=sha256:[0-9a-f]{64})+', line), line[
            :80
        ]


def bare(requirements):
    """Names without version bounds."""
    return {name.partition('>')[0].partition('<')[0] for name in requirements}


def asked_in_setup_py():
    """Requirements of thinmap, and its extras."""
    tree = ast.parse((ROOT / 'setup.py').read_text())
    given = {node.arg: node.value for node in ast.walk(tree) if isinstance(node, ast.keyword)}
    return [ast.literal_eval(given[name]) for name in ('install_requires', 'extras_require')]


def test_setup_py_and_the_requirements_ask_for_the_same():
    needed, extras = asked_in_setup_py()
    python, test, viewer = (
        names_in(ROOT / 'requirements' / f'{part}.in') for part in ('python', 'test', 'viewer')
    )
    assert bare(needed) == bare(python) - BUILDERS
    tested = [name for extra in ('test', 'cluster', 'completion', 'web') for name in extras[extra]]
    assert bare(tested) == bare(test) - CHECKERS
    assert set(extras['viewer']) == viewer.keys(), 'with the same bounds'


def test_setup_py_and_package_xml_ask_for_the_same():
    tree = ElementTree.parse(ROOT / 'package.xml')
    needed, extras = asked_in_setup_py()
    run_with = needed + extras['completion'] + extras['web']
    wanted = ((bare(run_with), 'exec_depend'), (extras['test'], 'test_depend'))
    for names, tag in wanted:
        keys = {KEYS.get(name, f'python3-{name}') for name in names} - {None}
        assert keys == {e.text for e in tree.iter(tag) if e.text.startswith('python3-')}


@pytest.mark.parametrize('lock', LOCKS)
def test_a_lock_pins_all_that_is_asked_for(lock):
    pinned = names_in(ROOT / 'requirements' / lock)
    assert all(pinned.values())
    for part in LOCKS[lock]:
        asked = names_in(ROOT / 'requirements' / f'{part}.in')
        assert bare(asked) <= pinned.keys()


@pytest.mark.skipif(
    not Path(sys.prefix).is_relative_to(ROOT / '.setup') or sys.prefix == sys.base_prefix,
    reason='what is installed is pinned in the environment of scripts/env only',
)
def test_no_test_waits_for_a_package_that_is_never_installed():
    lock = ROOT / 'requirements' / 'lock-{}.{}.txt'.format(*sys.version_info[:2])
    pinned = names_in(lock)
    assert {name: version(name) for name in pinned if version(name) != pinned[name]} == {}


@pytest.mark.parametrize('name', PROGRAMS)
def test_every_program_is_installed_where_ros2_run_looks(name):
    assert (Path(get_package_prefix('thinmap_ros')) / 'lib' / 'thinmap_ros' / name).exists()


@pytest.mark.parametrize('folder', ['config', 'worlds'])
def test_files_for_users_are_installed(folder):
    installed = Path(get_package_share_directory('thinmap_ros')) / folder
    assert sorted(p.name for p in installed.iterdir()) == sorted(
        p.name for p in (ROOT / folder).iterdir()
    )


@pytest.mark.programs
@pytest.mark.parametrize('name', TOOLS)
def test_every_tool_has_help(name):
    done = forked.run(f'thinmap_ros.tools.{name}', '--help')
    assert done.returncode == 0, done.stderr
    assert 'usage' in done.stdout


def test_versions_agree():
    citation = yaml.safe_load((ROOT / 'CITATION.cff').read_text())
    setup = (ROOT / 'setup.py').read_text()
    changelog = (ROOT / 'CHANGELOG.md').read_text()
    released = re.search(r'^## \[(\d+\.\d+\.\d+)\] - (\S+)$', changelog, re.MULTILINE)
    assert {ElementTree.parse(path).find('version').text for path in MANIFESTS} == {__version__}
    assert '\n    version=version(),\n' in setup  # of thinmap_ros/__init__.py
    assert (citation['version'], released[1]) == (__version__, __version__)
    assert str(citation['date-released']) == released[2]
