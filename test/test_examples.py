"""Each example runs as in its docstring, without ROS, and uses public names only."""

import ast
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from support.hidden_library import hide_ros

import thinmap_ros
from docs import commands

pytestmark = pytest.mark.programs

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / 'examples').glob('*.py'))
MAX_LINES = 40


def output_of(folder: Path, *words: str) -> str:
    command = [sys.executable, *words]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Runs an example and returns what it printed."""
    monkeypatch.setenv('PYTHONPATH', str(ROOT), prepend=':')
    hide_ros(tmp_path, monkeypatch)

    def run(name: str, *arguments: str) -> str:
        return output_of(tmp_path, str(ROOT / 'examples' / f'{name}.py'), *arguments)

    return run


@pytest.mark.parametrize('path', EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_uses_public_names(path: Path) -> None:
    text = path.read_text()
    tree = ast.parse(text)
    assert len(text.splitlines()) < MAX_LINES
    assert f'Usage: python examples/{path.name}' in (ast.get_docstring(tree) or '')
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module.startswith('thinmap_ros'):
            assert node.module == 'thinmap_ros'
            assert {name.name for name in node.names} <= set(thinmap_ros.__all__)


@pytest.mark.parametrize('path', EXAMPLES, ids=lambda path: path.stem)
def test_an_example_has_help(path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, 'argv', [str(path), '--help'])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(path), run_name='__main__')
    assert end.value.code == 0
    assert f'Usage: python examples/{path.name}' in capsys.readouterr().out


def test_every_example_is_run_here() -> None:
    run_here = set(re.findall(r"example\('(\w+)'", Path(__file__).read_text()))
    assert run_here == {path.stem for path in EXAMPLES}


def test_slam_on_a_log_and_a_route_on_its_map(example, tmp_path: Path) -> None:
    folder = tmp_path / 'out'
    said = example('slam_on_a_log', str(ROOT / 'bags' / 'dead_end.mcap'), str(folder))
    assert re.fullmatch(
        r'StampedPoses\(219 poses, 8\.\d m\)\nTopologicalMap\(\d+ nodes, \d+ edges\)\n', said
    )
    assert {path.name for path in folder.iterdir()} == {
        'map.pgm',
        'map.yaml',
        'route.geojson',
        'final.tum',
    }
    said = example('route_graph', str(folder / 'map.yaml'), '0,0', '6,0')
    assert re.fullmatch(r'\d+ nodes, \d+ edges\n\d+\.\d m over nodes \d+(, \d+)+\n', said)


def test_explore_in_simulation(example) -> None:
    said = example('explore_in_simulation')
    assert 'all end nodes resolved' in said
    # Less than 0.5 m2 of nearly 100 are left: what is worth a visit is seen.
    assert re.search(r'(100\.0|99\.[5-9])% seen, 0 collisions', said)


def test_thinning(example) -> None:
    skeleton = example('thinning')
    assert skeleton.count('\n') == 10
    assert 20 < skeleton.count('o') < 60


def test_find_the_robot(example) -> None:
    said = example('find_the_robot', 'lab', str(ROOT / 'bags' / 'lab_lost.mcap'))
    assert re.fullmatch(r'after \d+ scans: x 2\.\d+ m, y [12]\.\d+ m, heading \S+ rad\n', said)


def test_python_in_the_readme_runs(example, tmp_path: Path) -> None:
    (tmp_path / 'bags').symlink_to(ROOT / 'bags')
    (block,) = commands.python_blocks(ROOT / 'README.md').values()
    output_of(tmp_path, '-c', block)
    assert (tmp_path / 'dead_end.geojson').exists()
