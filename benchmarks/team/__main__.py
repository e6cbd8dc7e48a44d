"""Several robots against one, and what trouble between them costs.

Usage: python -m benchmarks.team [WORLD ...] -o FILE.csv [--cases CASE ...] [--seed N].

Each run is a line of the file, written as soon as it ends; runs that are in the file are not run
again. A single run scatters by 4 to 7 %: means over worlds count.
"""

import argparse
from pathlib import Path

import numpy as np

from benchmarks.rows import add_record, markdown, read_records
from benchmarks.team.cases import BASES, CASES
from benchmarks.worlds import WORLDS, floors

_COLUMNS = (
    'case',
    'against',
    'runs',
    'time',
    'distance',
    'least coverage',
    'contacts',
    'bytes a metre',
)
_WORLDS = ('dungeon/d114', 'dungeon/d1305', 'kth/50052751', 'kth/50052748')


def table(records: list[dict[str, str]]) -> str:
    """Mean ratios of each case to its base over the worlds and seeds of both, as Markdown."""
    by_key = {(r['case'], r['world'], r['seed']): r for r in records}
    rows = []
    for case, base in BASES.items():
        pairs = [
            (record, by_key[base, world, seed])
            for (name, world, seed), record in by_key.items()
            if name == case and (base, world, seed) in by_key
        ]
        if not pairs:
            continue
        ratios = [
            '{:.3f} +- {:.3f}'.format(*_mean([float(a[key]) / float(b[key]) for a, b in pairs]))
            for key in ('time_s', 'distance_m')
        ]
        sent = np.mean([float(a['claim_bytes_m']) + float(a['tile_bytes_m']) for a, _ in pairs])
        least = min(float(a['least_coverage']) for a, _ in pairs)
        contacts = sum(int(a['contacts']) for a, _ in pairs)
        rows.append([case, base, len(pairs), *ratios, f'{least:.4f}', contacts, f'{sent:.0f}'])
    return markdown(_COLUMNS, rows)


def _mean(values: list[float]) -> tuple[float, float]:
    """Mean and its standard error, 0 of one value."""
    count = len(values)
    spread = float(np.std(values, ddof=1)) if count > 1 else 0.0
    return float(np.mean(values)), spread / float(np.sqrt(count))


def main() -> None:
    """Run the cases in the worlds, and print the table."""
    parser = argparse.ArgumentParser(prog='benchmarks.team', description=__doc__)
    parser.add_argument('worlds', nargs='*', help=f'names (default: {" ".join(_WORLDS)})')
    parser.add_argument('-o', '--output', type=Path, required=True, help='CSV file')
    parser.add_argument(
        '--cases', nargs='+', choices=CASES, default=CASES, help='some of the cases'
    )
    parser.add_argument('--seed', type=int, default=0, help='decides all noise (default 0)')
    parser.add_argument('--folder', type=Path, default=WORLDS, help='folder with worlds.json')
    arguments = parser.parse_args()
    known = {floor.name: floor for floor in floors(arguments.folder)}
    wanted = arguments.worlds or list(_WORLDS)
    if missing := set(wanted) - known.keys():
        parser.error(f'unknown world {sorted(missing)[0]!r}: expected some of {", ".join(known)}')
    done = {(r['case'], r['world'], r['seed']) for r in read_records(arguments.output)}
    for world in wanted:
        for case in arguments.cases:
            if (case, world, str(arguments.seed)) in done:
                continue
            figures = CASES[case].run(known[world], arguments.seed)
            record = {'case': case, 'world': world, 'seed': arguments.seed, **figures}
            add_record(arguments.output, record)
            print(record, flush=True)
    print(table(read_records(arguments.output)))


if __name__ == '__main__':
    main()
