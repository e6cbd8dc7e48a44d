"""The command `thinmap`, from the source tree and from a wheel, without ROS."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from support.hidden_library import hide_ros
from support.peers.foreign_map import write_foreign_map

from thinmap_ros import __main__ as command
from thinmap_ros import __version__

pytestmark = pytest.mark.programs

ROOT = Path(__file__).resolve().parents[1]
TOOLS = ROOT / 'thinmap_ros' / 'tools'
OF_A_WHEEL = ['setup.py', 'setup.cfg', 'pyproject.toml', 'thinmap_ros', 'worlds', 'config']
OF_A_WHEEL += ['thinmap_msgs']
BUILDS_WHEELS = 71


def run(*words: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, '-m', 'thinmap_ros', *words]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd)


def test_every_tool_is_a_subcommand() -> None:
    tools = {path.stem for path in TOOLS.glob('*.py') if 'def main(' in path.read_text()}
    assert set(command.PROGRAMS) == tools | {'nodes'}
    for program in command.PROGRAMS.values():
        assert importlib.util.find_spec(f'thinmap_ros.{program.module}') is not None


def test_help_lists_each_subcommand_in_one_line() -> None:
    done = run('--help')
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    for name, program in command.PROGRAMS.items():
        (line,) = [line for line in lines if line.split()[:1] == [name]]
        assert program.summary in line
        assert len(line) <= 100


def test_it_tells_its_version() -> None:
    assert run('--version').stdout == f'thinmap {__version__}\n'


def test_without_words_it_prints_the_help() -> None:
    done = run()
    assert done.returncode == 0
    assert done.stdout == run('--help').stdout


def test_a_wrong_name_is_one_line_and_exit_code_2() -> None:
    done = run('frobnicate')
    assert done.stderr.startswith("thinmap: error: 'frobnicate': no such subcommand")
    assert done.returncode == 2
    assert done.stdout == ''
    assert done.stderr.count('\n') == 1


def test_a_subcommand_has_its_own_arguments_and_errors() -> None:
    done = run('carmen_to_bag', '--help')
    assert done.stdout.startswith('usage: thinmap carmen_to_bag')
    done = run('carmen_to_bag', '/no/such.clf', '/no/bag')
    assert done.returncode == 2
    assert done.stderr.startswith('thinmap carmen_to_bag: error: /no/such.clf: ')


@pytest.mark.parametrize('unbuffered', ['', '1'])
@pytest.mark.parametrize('words', ['--help', '--version', 'evaluate --help', 'map_to_graph'])
def test_it_ends_in_silence_once_nobody_reads_what_it_prints(
    words: str, unbuffered: str, tmp_path: Path
) -> None:
    """As with `| head`: the code is that of a program which the signal of the pipe has ended."""
    if words == 'map_to_graph':
        words += f' {write_foreign_map(tmp_path, "room_10x10")} -o {tmp_path / "graph.geojson"}'
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, '-m', 'thinmap_ros', *words.split()],
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, 'PYTHONUNBUFFERED': unbuffered},
    )
    os.close(writer)
    assert done.stderr == ''
    # argparse itself ignores that its help is not read.
    assert done.returncode == (0 if unbuffered and 'evaluate' in words else 141)
    assert 'map_to_graph' not in words or (tmp_path / 'graph.geojson').exists()


@pytest.mark.parametrize(
    ('typed', 'offered'),
    [
        ('thinmap rep', ['replay ']),
        ('thinmap replay --las', ['--laser-pose ']),
        ('thinmap map-to-graph --pru', ['--prune-m ']),
        ('thinmap nodes lo', []),
    ],
)
def test_tab_completes_subcommands_and_options(
    typed: str, offered: list[str], tmp_path: Path
) -> None:
    said = tmp_path / 'offered.txt'
    variables = {
        **os.environ,
        '_ARGCOMPLETE': '1',
        '_ARGCOMPLETE_STDOUT_FILENAME': str(said),
        'COMP_LINE': typed,
        'COMP_POINT': str(len(typed)),
    }
    done = subprocess.run([sys.executable, '-m', 'thinmap_ros'], env=variables, text=True)
    assert done.returncode == 0
    words = said.read_text().split('\013') if said.exists() else []
    assert [word for word in words if word] == offered


@pytest.mark.parametrize('name', ['demo', 'nodes'])
def test_what_needs_ros_says_what_is_missing(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hide_ros(tmp_path, monkeypatch)
    done = run(name)
    assert done.returncode == 2
    assert done.stderr.startswith(f'thinmap: error: {name} needs ROS 2 Jazzy')
    assert 'rclpy' in done.stderr
    assert done.stderr.count('\n') == 1


@pytest.fixture(scope='module')
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which pip has installed the package, from a wheel built of a copy."""
    if importlib.util.find_spec('pip') is None:
        pytest.skip('needs pip')
    if int(version('setuptools').partition('.')[0]) < BUILDS_WHEELS:
        pytest.skip('needs a setuptools that builds wheels by itself')
    source = tmp_path_factory.mktemp('source')
    for name in OF_A_WHEEL:
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name, source / name, ignore=shutil.ignore_patterns('__pycache__')
            )
        else:
            shutil.copyfile(ROOT / name, source / name)
    target = tmp_path_factory.mktemp('installed')
    pip = [sys.executable, '-m', 'pip', 'install', '--quiet', '--no-deps', '--no-index']
    pip += ['--no-build-isolation', '--disable-pip-version-check', '--target', str(target)]
    # In pip's isolated environment: no package of the source tree hides the installed one.
    environment = {k: v for k, v in os.environ.items() if k != 'PYTHONPATH'}
    done = subprocess.run(
        [*pip, str(source)], capture_output=True, text=True, env=environment, cwd=target
    )
    assert done.returncode == 0, done.stderr
    return target


@pytest.fixture
def thinmap(installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Runs the installed command, without ROS and without the source tree."""
    monkeypatch.setenv('PYTHONPATH', str(installed))
    hide_ros(tmp_path, monkeypatch)

    def run_installed(*words: str) -> str:
        program = [sys.executable, str(installed / 'bin' / 'thinmap'), *words]
        done = subprocess.run(program, capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run_installed


def test_pip_installs_one_command_with_its_data(installed: Path) -> None:
    assert [path.name for path in (installed / 'bin').iterdir()] == ['thinmap']
    data = installed / 'thinmap_ros' / 'data'
    for inside, source in [
        ('thinmap_ros/worlds', 'worlds'),
        ('thinmap_ros/config', 'config'),
        ('thinmap_ros/config/robots', 'config/robots'),
        ('thinmap_ros/config/sensors', 'config/sensors'),
        ('thinmap_msgs/msg', 'thinmap_msgs/msg'),
    ]:
        names = {path.name for path in (data / inside).glob('*.*')}
        assert names == {path.name for path in (ROOT / source).glob('*.*')}
    assert (installed / 'thinmap_ros' / 'py.typed').exists()


def test_the_installed_command_replays_explores_and_makes_a_route_graph(
    thinmap, tmp_path: Path
) -> None:
    assert thinmap('--version') == f'thinmap {__version__}\n'
    bag = str(ROOT / 'bags' / 'dead_end.mcap')
    assert '219 scans' in thinmap('replay', bag, '-o', 'out/dead_end', '--quiet')
    said = thinmap('explore_world', 'room_10x10', '-o', 'out', '--quiet')
    assert re.search(r'coverage (100\.0|99\.[5-9])%', said)
    assert 'nodes' in thinmap('map_to_graph', 'out/map.yaml', '-o', 'route.geojson')
    assert (tmp_path / 'route.geojson').exists()


def test_the_installed_command_records_our_messages(thinmap, tmp_path: Path) -> None:
    assert '219 scans' in thinmap('record_bags', 'dead_end', '-o', 'bags')
    assert b'thinmap_msgs/msg/TopologicalMap' in (tmp_path / 'bags' / 'dead_end.mcap').read_bytes()
