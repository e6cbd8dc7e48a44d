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

from benchmarks.charts import DOCS
from benchmarks.rows import read_rows
from benchmarks.worlds import SHARED
from thinmap_ros.core.errors import ConfigError, InputError
from thinmap_ros.evaluation.parallel_jobs import commit, provenance
from thinmap_ros.files.safe import read_text, write_text
from thinmap_ros.tools import cli

MAX_MINUTES = 360
_LIMIT_FACTOR = 4  # of the expected time: a slower or busier machine
_MIN_LIMIT = 5
_STEPS = Path(__file__).with_suffix('.csv')


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
    """All steps in their order, as in release.csv: measurements, then pages.

    needs: patterns of names of steps before. command: of a module, with the folders.
    """
    found: list[Step] = []
    for name, minutes, needs, command in read_rows(_STEPS):
        words = [
            word.format(**vars(folders), shared=folders.data.parent) for word in command.split()
        ]
        before = (step.name for step in found)
        needed = tuple(n for n in before if any(fnmatch(n, part) for part in needs.split()))
        found.append(Step(name, (sys.executable, '-m', *words), int(minutes), needed))
    return found


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
        '--data', type=Path, default=SHARED / 'data', help='folder with logs and worlds'
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
