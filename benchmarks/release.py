"""Make all pages of results from this commit: measurements, then pages; resumable. See --help."""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from fnmatch import fnmatch
from pathlib import Path

from benchmarks.catalogue import BENCHMARKS
from benchmarks.charts import DOCS
from benchmarks.kidnapped.cases import ROWS
from benchmarks.scoreboard.board import KTH, WORLDS
from benchmarks.worlds import WORLDS as FLOORS
from thinmap_ros.core.errors import ConfigError, InputError
from thinmap_ros.evaluation.parallel_jobs import commit, provenance
from thinmap_ros.files.safe import read_text, write_text
from thinmap_ros.tools import cli

MAX_MINUTES = 360
_LIMIT_FACTOR = 4  # of the expected time: a slower or busier machine
_MIN_LIMIT = 5
_DUNGEONS = ('d1115', 'd114', 'd1573', 'd2191', 'd2555', 'd2720', 'd3088', 'd3486')
_SMALL_FLOORS = ('kth/50052751', 'kth/50052748')
_LOCALIZATION_MINUTES = 5  # of each row of benchmarks.kidnapped


@dataclass(frozen=True)
class Folders:
    """Where a release reads and writes: results, pages, and the folder with logs and worlds."""

    out: Path
    docs: Path
    data: Path


@dataclass(frozen=True)
class Step:
    """A command with the minutes that it is expected to take; needs: steps that come before."""

    name: str
    command: tuple[str, ...]
    minutes: int
    needs: tuple[str, ...] = ()

    @property
    def limit_s(self) -> float:
        """Time after which the step is ended, s."""
        return 60.0 * max(_MIN_LIMIT, _LIMIT_FACTOR * self.minutes)


def steps(folders: Folders) -> list[Step]:
    """All steps in their order: measurements, then pages."""
    measured = [
        *_slam(folders),
        *_speed(folders),
        *_exploration(folders),
        *_localization(folders),
        *_papers(folders),
        *_graphs(folders),
    ]
    return [*measured, *_pages(folders, [step.name for step in measured])]


def _python(module: str, *words: str | Path) -> tuple[str, ...]:
    return (sys.executable, '-m', module, *map(str, words))


def _slam(folders: Folders) -> list[Step]:
    own = ('-o', folders.out / 'slam', '--shared', folders.data.parent)
    board = _python('benchmarks.scoreboard', *own, '--board', '--quiet')
    return [
        Step('slam.board', board, 40),
        Step('slam.stamps', _python('benchmarks.scoreboard.stamps', *own), 3),
    ]


def _speed(folders: Folders) -> list[Step]:
    worlds = ('--worlds', folders.data / 'worlds', '--csv', folders.out / 'speed')
    return [
        Step(f'speed.{each.name}', _python('benchmarks', each.name, *worlds), each.minutes)
        for each in BENCHMARKS.values()
        if each.minutes
    ]


def _exploration(folders: Folders) -> list[Step]:
    dungeons = [f'dungeon/{name}' for name in _DUNGEONS]
    ours = ('--strategies', 'position_probability')
    usual = ('position_probability', 'nearest_frontier', 'explore_lite', 'paper', 'bounded_tour')
    pair = ('--strategies', 'position_probability', 'nearest_frontier')
    small = ('--beams', '360', '--field-of-view-deg', '360', '--range-max-m', '3.5')
    by_slam = ('--localization', 'slam', '--starts', '1', *ours)
    belief = _python('benchmarks.exploration.fit_belief', '-o', folders.out / 'belief')
    return [
        _compared(folders, 'random_worlds', dungeons, ('--strategies', *usual), 20),
        _compared(folders, 'floors', _SMALL_FLOORS, ('--strategies', *usual), 20),
        _compared(folders, 'random_world_3.5m', WORLDS[-2:-1], (*pair, *small), 3),
        _compared(folders, 'floor_3.5m', _SMALL_FLOORS[:1], (*pair, *small), 5),
        _compared(folders, 'floors_slam', KTH, by_slam, 10),
        _compared(folders, 'random_world_slam', WORLDS[-2:-1], by_slam, 2),
        Step('exploration.belief', belief, 10),
    ]


def _compared(
    folders: Folders,
    name: str,
    worlds: list[str] | tuple[str, ...],
    words: tuple[str, ...],
    minutes: int,
) -> Step:
    files = [folders.data / 'worlds' / f'{world}.yaml' for world in worlds]
    out = folders.out / 'exploration' / name
    own: tuple[str | Path, ...] = (*files, '-o', out, '--speed-m-s', '0.5', '--quiet')
    return Step(
        f'exploration.{name}',
        _python('thinmap_ros.tools.compare_exploration', *own, *words),
        minutes,
    )


def _localization(folders: Folders) -> list[Step]:
    log = folders.data / 'logs' / 'intel' / 'log.clf'
    words = ('-o', folders.out / 'localization', '--worlds', folders.data / 'worlds', '--log', log)
    return [
        Step(
            f'localization.{row}',
            _python('benchmarks.kidnapped', row, *words),
            _LOCALIZATION_MINUTES,
        )
        for row in ROWS
    ]


def _papers(folders: Folders) -> list[Step]:
    program = 'thinmap_ros.tools.experiment'
    out = ('-o', folders.out / 'papers')
    logs = (*out, '--logs', folders.data / 'logs')
    return [
        Step('papers.experiments', _python(program, 'all', *out), 30),
        Step('papers.logs', _python(program, 'logs', *logs), 5),
    ]


def _graphs(folders: Folders) -> list[Step]:
    """The page of graphs, which are made and measured for it in a minute."""
    maps = folders.data / 'maps'
    page = _python('benchmarks.graphs.real_maps_page', maps, folders.docs)
    return [Step('graphs.page', page, 1)]


def _pages(folders: Folders, measured: list[str]) -> list[Step]:
    out = folders.out
    docs = folders.docs
    explored = [name for name in measured if name.startswith('exploration.')]
    parts = [out / 'exploration' / name.partition('.')[2] for name in explored[:-1]]
    commands = {
        'slam': _python('benchmarks.scoreboard.results_page', out / 'slam', docs),
        'speed': _python('benchmarks.speed.page', out / 'speed', docs),
        'exploration': _python(
            'benchmarks.exploration.page', *parts, out / 'belief', '--docs', docs
        ),
        'localization': _python('benchmarks.kidnapped.page', out / 'localization', docs),
        'papers': _python(
            'thinmap_ros.tools.experiment', 'page', '-o', out / 'papers', '--docs', docs
        ),
    }
    pages = [
        Step(f'page.{name}', command, 1, tuple(n for n in measured if n.startswith(f'{name}.')))
        for name, command in commands.items()
    ]
    pages.append(_page_of(measured, ('slam',), 'peers', folders))
    pages.append(_page_of(measured, ('slam', 'speed', 'localization'), 'targets', folders))
    return pages


def _page_of(measured: list[str], parts: tuple[str, ...], name: str, folders: Folders) -> Step:
    needs = tuple(step for step in measured if step.partition('.')[0] in parts)
    module = f'benchmarks.{name}' if name == 'targets' else f'benchmarks.{name}_page'
    return Step(f'page.{name}', _python(module, folders.out, folders.docs), 1, needs)


_FILE = 'state.json'


@dataclass(frozen=True)
class Finished:
    """A finished step: its command, how long it took, s, and when it ended (UTC, ISO 8601)."""

    command: list[str]
    seconds: float
    ended: str


@dataclass(frozen=True, eq=False)
class State:
    """Finished steps of a commit on a machine, by name."""

    commit: str
    machine: str
    steps: dict[str, Finished] = field(default_factory=dict)


def read_state(folder: Path, commit: str, machine: str) -> State:
    """State of a folder; a new one if the folder has none.

    Raises InputError if it is damaged, or of another commit or machine: its results would be mixed
    with those of this one.
    """
    path = folder / _FILE
    if not path.exists():
        return State(commit, machine)
    try:
        words = json.loads(read_text(path))
        steps = {name: Finished(**step) for name, step in words['steps'].items()}
        known = State(words['commit'], words['machine'], steps)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f'{path}: damaged: expected the state of a release') from error
    for what, there, here in (
        ('commit', known.commit, commit),
        ('machine', known.machine, machine),
    ):
        if there != here:
            raise InputError(f'{path}: {what} {there}: expected {here}, or another folder by --out')
    return known


def write_state(folder: Path, state: State) -> None:
    """Write the state to its folder."""
    write_text(folder / _FILE, json.dumps(asdict(state), indent=2) + '\n')


_END_S = 30.0  # to end after Ctrl-C, before it is killed


def run_steps(chosen: Sequence[Step], folder: Path, state: State, limit_s: float) -> dict[str, str]:
    """Run the steps without a result, and write the state after each. Returns what failed, and why.

    limit_s: of all steps together; the step that runs then ends. Ctrl-C ends the step that runs,
    and is raised again; the steps before stay finished.
    """
    failed: dict[str, str] = {}
    end = time.monotonic() + limit_s
    for number, step in enumerate(chosen, 1):
        head = f'[{number}/{len(chosen)}] {step.name}'
        if step.name in state.steps:
            print(f'{head}: finished before, {state.steps[step.name].seconds:.0f} s', flush=True)
            continue
        print(f'{head}: some {step.minutes} min', flush=True)
        began = time.monotonic()
        reason = _attempt(step, folder, state, end - began)
        seconds = time.monotonic() - began
        if reason:
            failed[step.name] = reason
            print(f'{head}: failed: {reason}', flush=True)
            continue
        ended = datetime.now(UTC).isoformat(timespec='seconds')
        state.steps[step.name] = Finished(list(step.command), round(seconds, 1), ended)
        write_state(folder, state)
        print(f'{head}: {seconds:.0f} s', flush=True)
    return failed


def _attempt(step: Step, folder: Path, state: State, left_s: float) -> str:
    """Run a step if what it needs is there and time is left. Returns why it failed, or nothing."""
    missing = [name for name in step.needs if name not in state.steps]
    if missing:
        return f'needs {", ".join(missing)}'
    if left_s <= 0.0:
        return 'no time is left: the same command continues'
    return run_step(step, folder / 'logs' / f'{step.name}.txt', min(step.limit_s, left_s))


def run_step(step: Step, log: Path, limit_s: float) -> str:
    """Run a step with its output in a file. Returns why it failed, or an empty text."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open('wb') as output:
        # A session of its own: all that the step has started ends with it.
        process = subprocess.Popen(
            step.command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            code = process.wait(timeout=limit_s)
        except subprocess.TimeoutExpired:
            return f'not finished after {limit_s:.0f} s'
        finally:
            _end(process)
    if code == 0:
        return ''
    lines = log.read_text(encoding='utf-8', errors='replace').strip().splitlines()
    return f'exit code {code}: {lines[-1] if lines else "no output"}'


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process and all of its session, as by Ctrl-C, then by force."""
    if process.poll() is not None:
        return
    os.killpg(process.pid, signal.SIGINT)
    with suppress(subprocess.TimeoutExpired):
        process.wait(timeout=_END_S)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


_ROOT = Path(__file__).resolve().parents[1]
_DESCRIPTION = f"""\
Run all generators of results in their order, in at most {MAX_MINUTES // 60} hours, and write the
pages of docs/results and docs/development/targets.md. What is finished at this commit is not run
again: after Ctrl-C or an error, the same command continues. Results are in a folder for each
commit, with state.json and logs/.
"""


def main(words: Sequence[str]) -> None:
    """Run the command line."""
    sys.argv = ['benchmarks release', *words]
    cli.run(_run, _parser())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='benchmarks release',
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--list', action='store_true', help='list the steps, and run none')
    parser.add_argument(
        '--only',
        nargs='+',
        metavar='NAME',
        default=['*'],
        help='steps whose names match, such as "speed.*" (default: all)',
    )
    parser.add_argument(
        '-o',
        '--out',
        type=Path,
        default=_ROOT / 'out' / 'release',
        help='folder with a folder for each commit (default out/release)',
    )
    parser.add_argument('--docs', type=Path, default=DOCS, help='folder of the pages')
    parser.add_argument(
        '--data', type=Path, default=FLOORS.parent, help='folder with logs and worlds'
    )
    return parser


def _run(arguments: argparse.Namespace) -> None:
    known = commit(_ROOT) or 'unknown'
    folder = arguments.out / known.partition(' ')[0]
    folders = Folders(folder, arguments.docs, arguments.data)
    chosen = matching(steps(folders), arguments.only)
    if arguments.list:
        state = read_state(folder, known, provenance())
        print(listing(chosen, state))
        return
    if ' ' in known:
        raise InputError(f'commit {known}: expected a committed tree: its pages name the commit')
    state = read_state(folder, known, provenance())
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends the step that runs, too
    failed = run_steps(chosen, folder, state, 60.0 * MAX_MINUTES)
    if failed:
        raise InputError(f'{len(failed)} steps failed: {", ".join(failed)}; outputs: {folder}/logs')


def matching(all_steps: Sequence[Step], patterns: Sequence[str]) -> list[Step]:
    """Steps whose names match one of the patterns. Raises ConfigError for one that none matches."""
    for pattern in patterns:
        if not any(fnmatch(step.name, pattern) for step in all_steps):
            names = ', '.join(step.name for step in all_steps)
            raise ConfigError(f'--only {pattern}: expected some of {names}')
    return [step for step in all_steps if any(fnmatch(step.name, word) for word in patterns)]


def listing(chosen: Sequence[Step], state: State) -> str:
    """Text of the steps: name, minutes expected and at most, minutes taken, and command."""
    lines = [f'{"step":<30} {"min":>4} {"limit":>6} {"taken":>6}  command']
    for step in chosen:
        finished = state.steps.get(step.name)
        taken = f'{finished.seconds / 60.0:.1f}' if finished else ''
        command = ' '.join(('python', *step.command[1:]))
        limit = f'{step.limit_s / 60.0:.0f}'
        lines.append(f'{step.name:<30} {step.minutes:>4} {limit:>6} {taken:>6}  {command}')
    total = sum(step.minutes for step in chosen)
    return '\n'.join([*lines, f'{"sum":<30} {total:>4}'])
