"""Every command line of README.md, the tutorials and the how-to guides runs as documented.

The commands of a page are given to bash one after the other, in a shell as `source scripts/env`
makes it, in a folder where the files have the names that the text uses. A page that is new has to
be named here, with what it needs beside it; its lines then run by themselves. What a page shows as
their output is what they print (`printed.py`).
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from support.carmen_log import carmen_lines
from support.ros1_bag import ros1_bag
from support.timeouts import PATIENCE_S

from docs import commands, printed
from thinmap_ros.files import occupancy_maps, package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.logs.log import LaserOptions
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.nodes.thinmap import chosen_nodes
from thinmap_ros.tools.carmen_to_bag import convert

pytestmark = [pytest.mark.live, pytest.mark.timeout(400)]
ROOT = Path(__file__).resolve().parents[2]
GUIDES = [
    p for kind in ('tutorials', 'how_to') for p in sorted((ROOT / 'docs' / kind).glob('*.md'))
]
DOCUMENTS = [ROOT / 'README.md', *GUIDES]
COMMANDS = [command for path in DOCUMENTS for command in commands.commands(path)]

# printed.Printed text below commands. test_printed.py compares the messages.
SHOWN = {
    path.name: [
        block
        for block in printed.blocks(path)
        if not block.is_message and (block.of is None or block.of[0] == 'bash')
    ]
    for path in DOCUMENTS
}

# Marked in the documents, and why. No more than nine marks.
NOT_RUN = {
    'scripts/demo --view': 'opens a window',
    ".setup/venv/bin/pip install 'rerun-sdk>=0.41,<0.42'": 'fetches 740 MB',
    'scripts/screenshot out/demo/recording.rrd out/demo/viewer.png': 'needs rerun and an X server',
    'cd ws/src && git clone <this repository> thinmap && cd ..': 'the workspace of a user',
    'echo "yaml file://$PWD/src/thinmap/rosdep.yaml" | '
    'sudo tee /etc/ros/rosdep/sources.list.d/50-thinmap.list': 'as above',
    'rosdep update': 'as above',
    'rosdep install --from-paths src/thinmap src/thinmap/thinmap_msgs --ignore-src -y': 'as above',
    'colcon build --base-paths src/thinmap src/thinmap/thinmap_msgs': 'as above; CI does it',
    'source install/setup.bash': 'as above',
    'thinmap warm_up': 'as above',
    'ros2 run thinmap_ros thinmap': 'as above; other pages have it, too',
    'ros2 run thinmap_ros rerun_viewer': 'needs rerun, opens a window',
    'rviz2 -d $(ros2 pkg prefix --share thinmap_ros)/config/thinmap.rviz': 'opens a window',
    'pip install .': 'test/test_command.py installs a wheel and runs what follows',
    'thinmap --help': 'as above',
    'thinmap replay bags/dead_end.mcap -o out/dead_end': 'as above',
    'thinmap explore_world room_10x10 -o out/room': 'as above',
    'thinmap map_to_graph out/room/map.yaml -o out/room.geojson': 'as above',
    'ros2 security create_keystore keys': 'the ros2 of the wheels has no such command',
    'ros2 security create_enclave keys /robot': 'as above',
    'export ROS_SECURITY_KEYSTORE=$PWD/keys ROS_SECURITY_ENABLE=true '
    'ROS_SECURITY_STRATEGY=Enforce': 'as above',
    'ros2 run thinmap_ros thinmap --ros-args --enclave /robot': 'as above',
    'ros2 run thinmap_ros web --ros-args -p host:=0.0.0.0 '
    '-p web_token_file:=$HOME/thinmap_tokens': 'writes into the home of the user',
    'scripts/fuzz': 'hours; test/fuzz runs a part of it',
    'scripts/endurance --faults': 'hours',
}
MAX_MARKS = 9

# Too long for every run: only their help is run, to check script, program and options.
HELP_ONLY = {
    'scripts/demo': 'test/live/test_demo.py runs the demo to its end',
    'scripts/demo --robots 2': 'as above',
    'scripts/test': 'what has started this test',
    'thinmap doctor --try-watchdog': 'turns a robot: test/live/test_doctor.py',
    'thinmap robot --preset turtlebot4 --explore --web --save maps/office': (
        'test/live/test_robot_command.py runs it'
    ),
    'thinmap robot --preset turtlebot4 --map maps/office': 'as above',
    'scripts/endurance': 'hours; scripts/endurance --minutes 10 is for releases',
    'scripts/experiment all': 'test/experiments/test_experiments.py runs each experiment',
}
# With a smaller input, or shortened by options that the same lines of the documents name.
SHORTER = {
    'thinmap explore_world office -o out/office --robots 2 --speed-m-s 0.5': (
        'thinmap explore_world room_10x10 -o out/office --robots 2 --speed-m-s 0.5'
    ),
    'scripts/experiment exploration': 'scripts/experiment exploration --from-bag bags',
}

# Errors of commands whose exit code is 0 all the same.
FAILED = (
    'Traceback',
    'success=False',
    'Setting parameter failed',
    'Transitioning failed',
    'compiling kernels',  # the set-up has compiled all that a documented command needs
)


Nodes = dict[str, dict[str, Any]]
SIM: Nodes = {'sim': {'start': '2.0,2.0,0.0'}}
ALL_NODES: Nodes = {
    'thinmap': {'use_sim_time': True, 'initial_x_m': 2.0, 'initial_y_m': 2.0},
    **SIM,
}
# Nodes that run beside the commands of a page, with their parameters.
PAGES: dict[str, Nodes] = {
    'README.md': SIM,
    'explore_in_simulation.md': {},
    'first_robot.md': {},
    'replay_a_bag.md': {},
    'global_localization.md': SIM,
    'install.md': {},
    'leave_it_running.md': {'localizer': {}},
    'security.md': {},
    'sessions.md': ALL_NODES,
    'several_machines.md': {},
    'troubleshooting.md': {'localizer': {}},
    'tune_a_laser.md': {},
    'two_robots.md': {},
    'use_nav2.md': SIM,
    'web_page.md': {},
    'what_a_driver_must_publish.md': SIM,
}

ENDS_BY_ITSELF = ('bag_player',)
_START = 'ros2 run thinmap_ros '


def nodes_of_package() -> set[str]:
    modules = (ROOT / 'thinmap_ros' / 'nodes').glob('[!_]*.py')
    return {module.stem for module in modules} - set(ENDS_BY_ITSELF)


def told_by(text: str) -> list[str]:
    """Names under which the nodes of a command publish on /diagnostics."""
    words = text.split('--ros-args')[0].split('#')[0].removesuffix('&').split()
    program = words[3]
    renamed = re.search(r'__node:=(\w+)', text)
    names = (
        chosen_nodes(words[4:]) if program == 'thinmap' else [renamed[1] if renamed else program]
    )
    space = re.search(r'__ns:=/(\S+)', text)
    prefix = f'{space[1]}/' if space else ''
    return [f'{prefix}{name}: thinmap' for name in names]


def kind_of(text: str) -> str:
    """How a command ends: by itself, or by a signal."""
    run = re.match(r'ros2 run thinmap_ros (\w+)', text)
    if run and (run[1] in nodes_of_package() or 'start_paused:=true' in text):
        return 'node'
    if re.match(r'ros2 topic (hz|echo (?!.*--once))', text):
        return 'listener'
    return 'goal' if text.startswith('ros2 action send_goal') else 'program'


def shown_after(command: commands.Command) -> printed.Printed | None:
    """What a page shows as the output of a command that is the only one before it."""
    block = [c for c in COMMANDS if (c.document, c.line) == (command.document, command.line)]
    waited_for = [c for c in block if not c.text.endswith('&')]
    after = [shown for shown in SHOWN[command.document] if shown.of == ('bash', command.line)]
    return after[0] if after and waited_for == [command] else None


class Line:
    """A command of the documents, in its own bash, as in a separate terminal."""

    def __init__(
        self, command: commands.Command, number: int, folder: Path, environment: dict[str, str]
    ) -> None:
        self.text = text = shortened(command.text)
        self.shown = shown_after(command)
        self._log = folder / f'line{number}.txt'
        # Background jobs have their own process group and receive SIGINT, as in a terminal.
        script = f'set -m\n{text}\nstatus=$?\n[ -z "$!" ] || wait $! || exit\nexit $status'
        with self._log.open('wb') as log:
            self.process = subprocess.Popen(
                ['bash', '-c', script],
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def said(self) -> str:
        return self._log.read_text()

    def has_printed_what_is_shown(self) -> bool:
        return self.shown is None or self.shown.is_in(self.said())

    def code_when_it_ends(self) -> int:
        """Its exit code: a listener is ended by Ctrl-C, and a goal whose result is not shown."""
        kind = kind_of(self.text)
        ends_well = kind in ('node', 'program') or (kind == 'goal' and self.shown is not None)
        return 0 if ends_well else signal.SIGINT

    def has_ended(self) -> bool:
        return self.process.poll() is not None

    def interrupt(self) -> None:
        """Press Ctrl-C."""
        for child in self._children():
            os.killpg(child.pid, signal.SIGINT)

    def _children(self) -> list[psutil.Process]:
        try:
            return psutil.Process(self.process.pid).children()
        except psutil.NoSuchProcess:
            return []

    def end(self, code: int) -> None:
        """Wait for the end, and check the exit code."""
        self.process.wait(timeout=PATIENCE_S)
        assert self.process.returncode == code, f'{self.text}\n{self.said()}'
        said = self.said()
        for bad in FAILED:
            # First what is wrong: reports are cut in the middle.
            assert bad not in said, f'{said[said.index(bad) :]}\n{self.text}\n{said}'

    def kill(self) -> None:
        for child in self._children():
            os.killpg(child.pid, signal.SIGKILL)
        self.process.kill()
        self.process.wait()


@pytest.fixture(scope='module')
def environment() -> dict[str, str]:
    """Variables of a shell after `source scripts/env`."""
    done = subprocess.run(
        ['bash', '-c', f'source {ROOT}/scripts/env && env -0'], capture_output=True, check=True
    )
    pairs = done.stdout.decode().rstrip('\0').split('\0')
    return dict(pair.split('=', 1) for pair in pairs)


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder in which the files of the documents are, with the project's scripts."""
    (tmp_path / 'LOG.clf').write_text('\n'.join(carmen_lines()) + '\n')
    (tmp_path / 'FOLDER' / 'NAME').mkdir(parents=True)
    (tmp_path / 'FOLDER' / 'NAME' / 'log.clf').write_text('\n'.join(carmen_lines()) + '\n')
    for bag in ('BAG', 'my_bag'):
        convert(CarmenLog(tmp_path / 'LOG.clf', LaserOptions()), tmp_path / bag)
    ros1_bag(tmp_path / 'my.bag')
    (tmp_path / 'bags').symlink_to(ROOT / 'bags')
    _, patch, _ = read_world(package_data.world_path('room_10x10'))
    (tmp_path / 'maps').mkdir()
    occupancy_maps.write_map(tmp_path / 'maps' / 'office', patch)
    for name in ('office', 'keepout_mask'):
        occupancy_maps.write_map(tmp_path / name, patch)
    _, floor, _ = read_world(package_data.world_path('office'))
    for name in ('maps/east', 'maps/west', 'other_program'):
        occupancy_maps.write_map(tmp_path / name, floor)
    _write_scripts(tmp_path / 'scripts')
    return tmp_path


def _write_scripts(folder: Path) -> None:
    """The project's scripts by their documented names.

    Experiments write here, not into the project's own results.
    """
    for path in (ROOT / 'scripts').rglob('*'):
        inside = path.relative_to(ROOT / 'scripts')
        if path.is_file() and os.access(path, os.X_OK) and inside.parts[0] != 'shim':
            more = ' -o "$PWD/out/experiments"' if inside.parts[0] == 'experiments' else ''
            (folder / inside).parent.mkdir(parents=True, exist_ok=True)
            (folder / inside).write_text(f'#!/usr/bin/env bash\nexec {path} "$@"{more}\n')
            (folder / inside).chmod(0o755)
    (folder / 'env').write_text(f'. {ROOT}/scripts/env\n')


def shortened(text: str) -> str:
    """Command as it is run here: most are unchanged."""
    bare = text.split('#')[0].strip()
    if bare in HELP_ONLY:
        return f'{bare} --help'
    return SHORTER.get(bare, text)


def run_page(
    graph: Any,
    page: str,
    listed: list[commands.Command],
    place: Path,
    environment: dict[str, str],
) -> None:
    """Run the commands of a page, and compare what it shows as their output with theirs."""
    health = graph.heard('/diagnostics', DiagnosticArray)
    running: list[Line] = []
    said: dict[int, str] = {}
    try:
        for command in listed:
            _end_namesakes(graph, running, command.text)
            while True:
                health.clear()
                line = Line(command, len(running), place, environment)
                running.append(line)
                _follow(graph, line, health)
                if '--once' not in line.text or line.has_printed_what_is_shown():
                    break
            said[command.line] = said.get(command.line, '') + line.said()
        for line in running:
            if not line.has_ended():
                line.interrupt()
            line.end(line.code_when_it_ends())
        for block in SHOWN[page]:
            compare(block, said, place)
    finally:
        for line in running:
            if not line.has_ended():
                line.kill()


def _end_namesakes(graph: Any, running: list[Line], text: str) -> None:
    """End nodes that a command starts again, as a reader does."""
    if kind_of(text) != 'node':
        return
    names = set(told_by(text))
    for program in [name for name in graph.processes if names & set(told_by(_START + name))]:
        assert graph.stop(program) == 0
    for line in running:
        is_namesake = kind_of(line.text) == 'node' and bool(names & set(told_by(line.text)))
        if is_namesake and not line.has_ended():
            line.interrupt()
            line.end(0)
    graph.drain()


def _follow(graph: Any, line: Line, health: list[DiagnosticArray]) -> None:
    """Wait until a command has had its effect."""
    kind = kind_of(line.text)
    if kind == 'node':
        names = set(told_by(line.text))
        _until(graph, line, lambda: names <= {s.name for a in health for s in a.status})
        return
    if line.text.endswith('&'):
        return
    if kind == 'program':
        _until(graph, line, line.has_ended, PATIENCE_S * 3.0)
        line.end(0)
        return
    if kind == 'goal' and line.shown is not None:
        _until(graph, line, line.has_ended)
        line.end(0)
        return
    first = 'Feedback:' if kind == 'goal' else '\n'
    _until(graph, line, lambda: first in line.said() and line.has_printed_what_is_shown())
    line.interrupt()
    line.end(signal.SIGINT)
    assert kind != 'goal' or line.said().endswith('Goal canceled.\n')


def compare(block: printed.Printed, said: dict[int, str], place: Path) -> None:
    """Check that a block is what its commands printed, or the begin of a file."""
    if block.file:
        content = json.loads((place / block.file).read_text())
        assert block.is_begin_of(content), f'{block.name}: {content}'
        return
    assert block.of is not None
    printed_text = said[block.of[1]]
    assert block.is_in(printed_text), (
        f'{block.name}: not printed: {block.missing(printed_text)}\n{printed_text}'
    )


def _until(
    graph: Any, line: Line, condition: Callable[[], Any], seconds: float = PATIENCE_S
) -> None:
    end = time.monotonic() + seconds
    while not condition():
        graph.executor.spin_once(timeout_sec=0.05)
        too_late = time.monotonic() > end
        failed = line.process.poll() not in (None, 0)
        if too_late or failed:
            pytest.fail(f'{line.text}\n{line.process.poll()}\n{line.said()[-3000:]}')


@pytest.mark.cpu_budget(50.0, 'each command of a page in a process of its own')
@pytest.mark.parametrize('page', PAGES)
def test_the_commands_of_a_page_run(graph, place, environment, page):
    listed = [c for c in COMMANDS if c.document == page and not c.marked]
    assert listed, f'{page}: no commands any more'
    for name, values in PAGES[page].items():
        graph.start(name, **values)
    shell = {**environment, 'ROS_DOMAIN_ID': os.environ['ROS_DOMAIN_ID']}
    shell['THINMAP_STATE_DIR'] = os.environ['THINMAP_STATE_DIR']
    run_page(graph, page, listed, place, shell)


@pytest.mark.parametrize('path', [path for path in GUIDES if commands.python_blocks(path)])
def test_python_in_the_tutorials_prints_what_they_show(place, path):
    blocks = commands.python_blocks(path)
    end = 'the end of a block'
    program = ''.join(f'{block}\nprint({end!r})\n' for block in blocks.values())
    shell = {**os.environ, 'PYTHONPATH': f'{ROOT}:{os.environ.get("PYTHONPATH", "")}'}
    done = subprocess.run(
        [sys.executable, '-c', program], cwd=place, env=shell, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    said = dict(zip(blocks, done.stdout.split(f'{end}\n'), strict=False))
    shown = [block for block in printed.blocks(path) if block.of and block.of[0] == 'python']
    for block in shown:
        printed_text = said[block.of[1]]
        assert block.is_in(printed_text), f'{block.name}: {printed_text}'
        assert len(block.text.splitlines()) == len(printed_text.splitlines()), block.name
    printing = {number for number, block in blocks.items() if 'print(' in block}
    assert {block.of[1] for block in shown} == printing, 'each has its output below it'


def test_no_command_is_left_out():
    pages = {c.document for c in COMMANDS if not c.marked}
    assert pages <= set(PAGES), 'not covered: name the page in PAGES'
    assert {c.text for c in COMMANDS if c.marked} == set(NOT_RUN)
    assert sum(commands.marks(path) for path in DOCUMENTS) <= MAX_MARKS
    texts = {c.text.split('#')[0].strip() for c in COMMANDS}
    assert set(HELP_ONLY) | set(SHORTER) <= texts


def test_commands_are_found_in_blocks_and_text(tmp_path):
    document = tmp_path / 'page.md'
    lines = [
        '# Page',
        '',
        'Say `ros2 topic',
        'list`, not `ros2 topic`.',
        '',
        '    ros2 run a b \\',
        '      -p c &',
        '    # none',
        '    ls  # c',
        '',
        '<!-- not run -->',
        '',
        '    rm x',
        '',
        '## Two',
        '',
        '1. A: <!-- not run --> `scripts/x`, `scripts/y`',
        '',
        '       cat z',
        '',
        '```',
        'echo w',
        '',
        '# n',
        '```',
        '```python',
        'print(1)',
        '```',
        '```text',
        'output',
        '```',
        '```bash',
        'echo v',
        '```',
    ]
    document.write_text('\n'.join(lines))
    found = [(c.section, c.text, c.marked) for c in commands.commands(document)]
    assert found == [
        ('Page', 'ros2 topic list', False),
        ('Page', 'ros2 run a b \\\n  -p c &', False),
        ('Page', 'ls  # c', False),
        ('Page', 'rm x', True),
        ('Two', 'scripts/x', True),
        ('Two', 'scripts/y', False),
        ('Two', 'cat z', False),
        ('Two', 'echo w', False),
        ('Two', 'echo v', False),
    ]
    assert commands.marks(document) == 2
    assert commands.python_blocks(document) == {26: 'print(1)\n'}
