"""Cases of a team: how many robots, which maps they have, and what goes wrong between them."""

import argparse
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.rows import add_record, markdown, read_records
from benchmarks.worlds import WORLDS, Floor, floor
from thinmap_ros.closed_loop.loop import TeamOptions
from thinmap_ros.closed_loop.radio import Trouble
from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.evaluation.exploration_run import explore_together
from thinmap_ros.sim.other_robots import starts_side_by_side
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.tools import cli

_SPEED_M_S = 0.5
_LIMIT_S = 5000.0
Record = dict[str, str | int | float]


@dataclass(frozen=True)
class Case:
    """Robots that start side by side; with has_own_maps they send each other tiles."""

    robots: int
    has_own_maps: bool = False
    localization: str = 'truth'
    trouble: Trouble = field(default_factory=Trouble)

    def run(self, floor: Floor, seed: int) -> Record:
        """Explore a floor from its first start; returns the figures."""
        radius_m = PRESETS[Options.robot].radius_m
        starts = starts_side_by_side(floor.world, floor.starts[0], self.robots, radius_m)
        options = Options(
            seed=seed,
            speed_m_s=_SPEED_M_S,
            localization=self.localization,
            time_limit_s=_LIMIT_S,
        )
        team = TeamOptions(trouble=self.trouble, has_own_maps=self.has_own_maps)
        loop, report = explore_together(floor.world, starts, options, team)
        robots = report.get('robots', [report])
        working = [
            robot['coverage']
            for number, robot in enumerate(robots)
            if not self.trouble.is_dead(number, loop.now_s)
        ]
        sent = report.get('bytes_per_m', {})
        return {
            'finished': int(report['finished']),
            'time_s': report['time'],
            't99_s': report['time_at']['0.99'] or '',
            'distance_m': report['distance'],
            'coverage': report['coverage'],
            'least_coverage': float(np.min(working)),
            'contacts': report['collisions'],
            'yielded_s': sum(robot.yielded_s for robot in loop.robots),
            'claim_bytes_m': sent.get('claims', 0.0),
            'tile_bytes_m': sent.get('tiles', 0.0),
            'cpu_s': report['cpu_s'],
        }


_OUT = Trouble(out_of_reach=(1, 60.0, 60.0))
_DEAD = Trouble(dead=(1, 60.0))
CASES = {
    '1': Case(1),
    '2': Case(2),
    '3': Case(3),
    '2 own maps': Case(2, has_own_maps=True),
    '3 own maps': Case(3, has_own_maps=True),
    '3 claims 5 s late': Case(3, has_own_maps=True, trouble=Trouble(claim_delay_s=5.0)),
    '3 one out of reach for 60 s': Case(3, has_own_maps=True, trouble=_OUT),
    '3 one dead from 60 s on': Case(3, has_own_maps=True, trouble=_DEAD),
    '3 a tenth of messages lost': Case(3, has_own_maps=True, trouble=Trouble(loss=0.1)),
    '1 SLAM': Case(1, localization='slam'),
    '2 SLAM': Case(2, localization='slam'),
}
# What each case is compared with.
BASES = {
    '2': '1',
    '3': '1',
    '2 own maps': '2',
    '3 own maps': '3',
    '3 claims 5 s late': '3 own maps',
    '3 one out of reach for 60 s': '3 own maps',
    '3 one dead from 60 s on': '2 own maps',
    '3 a tenth of messages lost': '3 own maps',
    '2 SLAM': '1 SLAM',
}


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
    """Run the command line."""
    parser = argparse.ArgumentParser(prog='benchmarks.team', description=__doc__)
    default = f'names (default: {" ".join(_WORLDS)})'
    parser.add_argument('worlds', nargs='*', default=_WORLDS, help=default)
    parser.add_argument('-o', '--output', type=Path, required=True, help='CSV file')
    parser.add_argument(
        '--cases', nargs='+', choices=CASES, default=CASES, help='some of the cases'
    )
    parser.add_argument('--seed', type=int, default=0, help='decides all noise (default 0)')
    parser.add_argument('--folder', type=Path, default=WORLDS, help='folder with worlds.json')
    cli.run(_run, parser)


def _run(arguments: argparse.Namespace) -> None:
    """Run the cases in the worlds, and print the table."""
    done = {(r['case'], r['world'], r['seed']) for r in read_records(arguments.output)}
    for world in arguments.worlds:
        for case in arguments.cases:
            if (case, world, str(arguments.seed)) in done:
                continue
            figures = CASES[case].run(floor(world, arguments.folder), arguments.seed)
            record = {'case': case, 'world': world, 'seed': arguments.seed, **figures}
            add_record(arguments.output, record)
            print(record, flush=True)
    print(table(read_records(arguments.output)))


if __name__ == '__main__':
    main()
