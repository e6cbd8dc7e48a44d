"""Mutation testing: change the code in one place at a time, and run its tests.

Survivors, which no test has found, are listed with file, line, and both texts. Mutants that change
no result are listed in test/mutants/equivalent.tsv with their reasons, and are not counted.
"""

import argparse
import csv
import hashlib
import shutil
import sys
import time
from pathlib import Path

from mutants.mutations import Mutation, mutations
from mutants.runner import Fate, Result, Workshop

ROOT = Path(__file__).resolve().parents[2]
EQUIVALENT = Path(__file__).parent / 'equivalent.tsv'
FOLDERS = ('thinmap_ros/core', 'thinmap_ros/files')
SEED = 39
COUNT = 200
LEAST_SHARE = 0.85

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
        '--limit-s', type=float, default=300.0, help='time for the tests of a mutant (default 300)'
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
    killers = sorted({result.test for result in results if result.test})
    broken = workshop.failures_without_mutant(killers, arguments.limit_s * len(killers))
    if broken:
        raise SystemExit(f'mutants: these tests fail without a mutant: {", ".join(broken)}')
    return results


def main(words: list[str] | None = None) -> int:
    """Run; the exit code is 1 if too many survive."""
    arguments = parsed(words)
    folder = arguments.root / 'out' / 'mutants'
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        results = run(arguments, folder)
    finally:
        shutil.rmtree(folder)
    survivors = [result for result in results if result.fate is Fate.SURVIVED]
    for result in survivors:
        print(f'survived: {described(arguments.root, result)}')
    share = 1.0 - len(survivors) / max(len(results), 1)
    print(f'seed {arguments.seed}: {share:.1%} of {len(results)} mutants killed')
    return int(share < LEAST_SHARE)


if __name__ == '__main__':
    sys.exit(main())
