"""Fuzz tests of all readers of external data, and of the core."""

import argparse
import os
import random
import shutil
import signal
import sys
import time
import warnings
from pathlib import Path

from fuzz.runner import LIMIT_S, NET, Outcome, Runner
from fuzz.sources import SOURCES

ROOT = Path(__file__).resolve().parents[2]


def parsed(words: list[str] | None) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(prog='fuzz', description=__doc__)
    parser.add_argument('--minutes', type=float, default=10.0, help='how long (default 10)')
    parser.add_argument('--seed', type=int, help='repeats the cases of one run')
    parser.add_argument(
        '--only', nargs='+', choices=sorted(SOURCES), default=list(SOURCES), help='these sources'
    )
    parser.add_argument('--cases', type=int, default=10**9, help='so many of each source at most')
    parser.add_argument('--first', type=int, default=0, help='number of the first case (default 0)')
    parser.add_argument(
        '--limit-s', type=float, default=LIMIT_S, help=f'CPU time of a case (default {LIMIT_S:g} s)'
    )
    parser.add_argument('--out', type=Path, default=ROOT / 'out' / 'fuzz', help='for what fails')
    return parser.parse_args(words)


def summary(outcome: Outcome, out: Path) -> str:
    """Report of the tested cases and the failures."""
    lines = [f'{name}: {count} cases' for name, count in sorted(outcome.tried.items())]
    alike: dict[tuple[str, str], list[int]] = {}
    for source, number, why in outcome.failures:
        alike.setdefault((source, why), []).append(number)
    for (source, why), numbers in alike.items():
        again = f'scripts/fuzz --seed {outcome.seed} --only {source} --first {numbers[0]} --cases 1'
        lines += [f'FAILED {len(numbers)} of {source}: {why}', f'  one of them again: {again}']
    ended = 'interrupted: ' if outcome.interrupted else ''
    kept = f', in {out / str(outcome.seed)}' if outcome.failures else ''
    total = outcome.tried.total()
    lines.append(f'{ended}seed {outcome.seed}: {total} cases, {len(outcome.failures)} failed{kept}')
    return '\n'.join(lines)


def main(words: list[str] | None = None) -> int:
    """Run; the exit code is 1 if a case has failed."""
    arguments = parsed(words)
    seed = arguments.seed
    if seed is None:
        seed = random.SystemRandom().randrange(10**9)
    # Enables SIGINT, which a background job of a shell ignores.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # From here on the runner handles it, to end with a summary.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    warnings.simplefilter('ignore')
    print(f'seed {seed}', flush=True)
    sources = [SOURCES[name] for name in arguments.only]
    limit_s = arguments.limit_s
    runner = Runner(sources, seed, arguments.out, limit_s, NET * limit_s)
    end_s = time.monotonic() + 60.0 * arguments.minutes
    outcome = runner.run(end_s, arguments.cases, arguments.first)
    print(summary(outcome, arguments.out), flush=True)
    shutil.rmtree(arguments.out / str(seed) / 'shared', ignore_errors=True)
    if not outcome.failures:
        shutil.rmtree(arguments.out / str(seed), ignore_errors=True)
    return 1 if outcome.failures else 0


if __name__ == '__main__':
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    sys.exit(main())
