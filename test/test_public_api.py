"""`from thinmap_ros import ...`: the public names, without ROS."""

import ast
import os
import subprocess
import sys
from importlib import import_module
from itertools import islice
from pathlib import Path

import pytest
from support.hidden_library import hide_ros

import thinmap_ros

pytestmark = pytest.mark.programs

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(autouse=True)
def without_ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hide_ros(tmp_path, monkeypatch)


def run(code: str) -> str:
    command = [sys.executable, '-c', code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_the_package_loads_no_library() -> None:
    loaded = run('import sys, thinmap_ros; dir(thinmap_ros); print(*sys.modules)').split()
    assert 'thinmap_ros' in loaded
    assert not {'numpy', 'numba', 'rclpy', 'rosbags', 'scipy'} & set(loaded)


def test_importing_the_package_changes_nothing_in_the_process() -> None:
    code = """
import os, signal
def state():
    return dict(os.environ), [signal.getsignal(number) for number in signal.valid_signals()]
before = state()
import thinmap_ros
print(state() == before)
"""
    assert run(code) == 'True\n'


def test_every_name_resolves_without_ros() -> None:
    code = """
import sys
from thinmap_ros import *
import thinmap_ros
print(*(type(globals()[name]).__name__ for name in thinmap_ros.__all__))
print('rclpy' in sys.modules)
"""
    kinds, ros = run(code).splitlines()
    assert len(kinds.split()) == len(thinmap_ros.__all__)
    assert ros == 'False'


def test_names_and_places_agree() -> None:
    assert thinmap_ros.__all__ == sorted(thinmap_ros._PLACES)
    for name, place in thinmap_ros._PLACES.items():
        module, _, attribute = place.rpartition('.')
        assert getattr(thinmap_ros, name) is getattr(
            import_module(f'thinmap_ros.{module}'), attribute
        )


def test_type_checkers_see_the_same_names_at_the_same_places() -> None:
    tree = ast.parse(Path(thinmap_ros.__file__).read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    assert ast.unparse(block.test) == 'TYPE_CHECKING'
    seen = {
        name.asname or name.name: f'{node.module}.{name.name}'.removeprefix('thinmap_ros.')
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    }
    assert seen == thinmap_ros._PLACES


def test_a_name_that_does_not_exist_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'thinmap_ros' has no attribute 'nothing'"):
        _ = thinmap_ros.nothing
    with pytest.raises(ImportError):
        from thinmap_ros import nothing  # noqa: F401


def test_what_a_notebook_shows_has_numbers_and_a_picture(tmp_path: Path) -> None:
    slam = thinmap_ros.Pipeline()
    log = thinmap_ros.open_log(str(ROOT / 'bags' / 'dead_end.mcap'))
    for scan, T_odom_base in islice(thinmap_ros.paired_scans(log), 20):
        slam.step(scan, T_odom_base)
    patch = slam.grid.known_area()
    graph = slam.topology.map
    assert repr(graph) == f'TopologicalMap({len(graph.nodes)} nodes, {len(graph.edges)} edges)'
    assert repr(slam) == f'Pipeline(20 scans, {patch!r}, {graph!r})'
    assert repr(patch).startswith(f'GridPatch({patch.shape[0]} x ')
    assert slam._repr_png_().startswith(b'\x89PNG')
    thinmap_ros.plot(patch, graph, title='by hand').savefig(tmp_path / 'map.png')
    assert (tmp_path / 'map.png').stat().st_size > 10_000
    with pytest.raises(thinmap_ros.InputError, match='plot: a int: expected a Pipeline'):
        thinmap_ros.plot(3)


def test_paths_may_be_texts(tmp_path: Path) -> None:
    stem = str(tmp_path / 'room')
    world = str(ROOT / 'worlds' / 'room_10x10.yaml')
    _, patch, _ = thinmap_ros.read_world(world)
    thinmap_ros.write_map(stem, patch)
    assert thinmap_ros.read_map(f'{stem}.yaml').shape == patch.shape
    graph = thinmap_ros.build_topology(patch, None, thinmap_ros.TopologyConfig())
    thinmap_ros.write_graph(f'{stem}.geojson', graph)
    assert (tmp_path / 'room.geojson').stat().st_size > 1000


def test_the_first_use_says_that_it_compiles(tmp_path: Path) -> None:
    code = """
import numpy as np
from thinmap_ros import thin
thin(np.ones((5, 5), dtype=np.bool_))
"""
    command = [sys.executable, '-c', code]
    environment = {**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path / 'empty')}
    # It says so before it compiles, which takes a while. Others test what follows.
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, cwd=ROOT, env=environment
    ) as process:
        assert process.stderr is not None
        first_line = process.stderr.readline()
        process.kill()
    assert first_line.startswith('thinmap: compiling kernels, once (1 of ')
