"""Mutation testing: change the code in one place at a time, and run its tests.

A mutant that computes several times as long as its tests do without it loops: its CPU limit kills
it. One that times out is not counted as killed: the machine may be busy, or something waits.
Survivors, which no test has found, are listed with file, line, and both texts. Mutants that change
no result are listed in test/mutants/equivalent.tsv with their reasons, and are not counted.
"""

import argparse
import csv
import hashlib
import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from mutants.mutations import Mutation, mutations
from mutants.runner import Fate, Result, Workshop

ROOT = Path(__file__).resolve().parents[2]
EQUIVALENT = Path(__file__).parent / 'equivalent.tsv'
FOLDERS = ('thinmap_ros/core', 'thinmap_ros/files')
SEED = 39
COUNT = 200
MIN_SHARE = 0.85
LIMIT_S = 900.0  # as that of a single test in pyproject.toml

# File, its line without and its line with the mutation.
Change = tuple[str, str, str]


def parsed(words: list[str] | None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(prog='mutants', description=__doc__)
    parser.add_argument('--count', type=int, default=COUNT, help=f'mutants (default {COUNT})')
    parser.add_argument('--seed', type=int, default=SEED, help=f'of the choice (default {SEED})')
    parser.add_argument('--first', type=int, default=0, help='begins at this one of them')
    parser.add_argument('--last', type=int, help='ends before this one of them')
    parser.add_argument('--only', default='', help='only paths that begin with this')
    parser.add_argument('--skip', nargs='*', default=[], help='no paths that begin with these')
    parser.add_argument(
        '--limit-s',
        type=float,
        default=LIMIT_S,
        help=f'time for the tests of a mutant, also where they wait (default {LIMIT_S:g})',
    )
    parser.add_argument('--root', type=Path, default=ROOT, help=argparse.SUPPRESS)
    parser.add_argument('--folders', nargs='+', default=FOLDERS, help=argparse.SUPPRESS)
    parser.add_argument('--equivalent', type=Path, default=EQUIVALENT, help=argparse.SUPPRESS)
    return parser.parse_args(words)


def equivalent_changes(path: Path) -> dict[Change, str]:
    """Reasons of the mutants that change no result."""
    with path.open(newline='') as lines:
        rows = csv.reader(lines, delimiter='\t', quoting=csv.QUOTE_NONE)
        return {(file, before, after): reason for file, before, after, reason in rows}


def change_of(root: Path, mutation: Mutation) -> Change:
    """File and texts of a mutation."""
    source = (root / mutation.path).read_bytes()
    return (mutation.path.as_posix(), *mutation.before_and_after(source))


def chosen(arguments: argparse.Namespace) -> list[Mutation]:
    """The same mutations for the same code, seed and count."""
    found: list[Mutation] = []
    for folder in arguments.folders:
        for file in sorted((arguments.root / folder).rglob('*.py')):
            found += mutations(file.relative_to(arguments.root), file.read_bytes())
    # By texts, not by positions: most of the choice is stable when other code changes.
    ranks = {mutation: _rank(arguments, mutation) for mutation in found}
    found.sort(key=lambda mutation: (ranks[mutation], mutation))
    return [m for m in found[: arguments.count] if _is_wanted(m, arguments)]


def _rank(arguments: argparse.Namespace, mutation: Mutation) -> bytes:
    words = repr((arguments.seed, *change_of(arguments.root, mutation)))
    return hashlib.sha256(words.encode()).digest()


def _is_wanted(mutation: Mutation, arguments: argparse.Namespace) -> bool:
    path = mutation.path.as_posix()
    return path.startswith(arguments.only) and not path.startswith(tuple(arguments.skip))


def described(root: Path, result: Result) -> str:
    """File, line, and the line's text without and with the mutation."""
    mutation = result.mutation
    path, before, after = change_of(root, mutation)
    line = mutation.line((root / mutation.path).read_bytes())
    return f'{path}:{line}\n    - {before}\n    + {after}'


def run(arguments: argparse.Namespace, folder: Path) -> list[Result]:
    """Test the mutants one by one, with a report of each."""
    reasons = equivalent_changes(arguments.equivalent)
    candidates = chosen(arguments)[arguments.first : arguments.last]
    tried = [m for m in candidates if change_of(arguments.root, m) not in reasons]
    print(f'{len(tried)} mutants, and {len(candidates) - len(tried)} equivalent ones')
    package = Path(arguments.folders[0]).parts[0]
    workshop = Workshop(arguments.root, package, folder)
    results: list[Result] = []
    for number, mutation in enumerate(tried, 1):
        began = time.monotonic()
        result = workshop.run(mutation, arguments.limit_s)
        results.append(result)
        line = mutation.line((arguments.root / mutation.path).read_bytes())
        place = f'{mutation.path.as_posix()}:{line}'
        seconds = time.monotonic() - began
        print(f'{number}: {result.fate.value} {seconds:.1f} s {place} {result.test}', flush=True)
    return results


def report(root: Path, results: list[Result]) -> Iterator[str]:
    """Lines: the mutants that were not killed, how many there are of each fate, and in all."""
    for fate in (Fate.TIMED_OUT, Fate.SURVIVED):
        for result in results:
            if result.fate is fate:
                yield f'{fate.value}: {described(root, result)}'
    counts = Counter(result.fate for result in results)
    for fate in Fate:
        yield f'{counts[fate]:5d} {fate.value}'


def share_killed(results: list[Result]) -> float:
    """Share of the mutants that were killed, of all."""
    return sum(result.fate.is_killed for result in results) / max(len(results), 1)


def main(words: list[str] | None = None) -> int:
    """Run; the exit code is 1 if too few are killed."""
    arguments = parsed(words)
    folder = arguments.root / 'out' / 'mutants'
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        results = run(arguments, folder)
    finally:
        shutil.rmtree(folder)
    for line in report(arguments.root, results):
        print(line)
    share = share_killed(results)
    print(f'seed {arguments.seed}: {share:.1%} of {len(results)} mutants killed')
    return int(share < MIN_SHARE)


if __name__ == '__main__':
    sys.exit(main())
