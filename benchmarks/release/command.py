"""The command `python -m benchmarks release`."""

import argparse
import signal
import sys
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path

from benchmarks.charts import DOCS
from benchmarks.release.runner import run_steps
from benchmarks.release.state import State, read_state
from benchmarks.release.steps import MAX_MINUTES, Folders, Step, steps
from benchmarks.worlds import WORLDS
from thinmap_ros.core.errors import ConfigError, InputError
from thinmap_ros.evaluation.parallel_jobs import commit, provenance
from thinmap_ros.tools import cli

_ROOT = Path(__file__).resolve().parents[2]
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
        '--data', type=Path, default=WORLDS.parent, help='folder with logs and worlds'
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
