"""Paper 2's claim: exploration by position probability is shorter than by the other schemes."""

from dataclasses import dataclass, replace

import numpy as np

from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.evaluation.exploration_run import explore
from thinmap_ros.evaluation.outcome import Comparison, Outcome, Rows, Table
from thinmap_ros.evaluation.strategy_comparison import (
    OURS,
    Report,
    half_interval_95,
    relative_saving,
)
from thinmap_ros.experiments.drives import Source, world_of
from thinmap_ros.sim.drives import random_start
from thinmap_ros.sim.world import World
from thinmap_ros.view.plots import Bars, Curve, Panel, Plot, xy

_WORLDS = ('room_10x10', 'office', 'lab')
_STRATEGIES = (
    OURS,
    'paper',
    'visit_all_end_nodes',
    'nearest_frontier',
    'explore_lite',
    'information_gain',
)
_NEARLY = '0.98'


@dataclass(frozen=True)
class _Setup:
    """Size of the comparison, and what counts as success.

    worlds: how many of _WORLDS. starts: random ones in each world. limit_s: time limit of a run.
    complete: coverage of runs whose lengths are compared. entire: coverage of an entire
    environment.
    """

    worlds: int
    starts: int
    limit_s: float
    complete: float
    entire: float


_FULL = _Setup(worlds=len(_WORLDS), starts=6, limit_s=3000.0, complete=0.95, entire=0.99)
_QUICK = replace(_FULL, worlds=1, starts=2, limit_s=10.0)


def run(source: Source) -> Outcome:
    """Explore from random starts with each strategy."""
    setup = _QUICK if source.quick else _FULL
    reports = [
        report
        for world in _WORLDS[: setup.worlds]
        for report in _reports(source.seed, setup, world)
    ]
    runs = {name: {_key(r): r for r in reports if r['strategy'] == name} for name in _STRATEGIES}
    summary = [_summary(name, runs) for name in _STRATEGIES]
    comparisons = [
        compare(name, runs)
        for name in _STRATEGIES[2:4]
        for compare in (_comparison, _until_nearly_all)
    ]
    comparisons += [
        Comparison(
            'least coverage of all runs',
            'the entire environment',
            f'{_least(runs[OURS]):.1%}',
            _least(runs[OURS]) >= setup.entire,
        ),
        Comparison(
            'end nodes visited, of those seen',
            'not all',
            f'{_share(runs[OURS]):.0%} '
            f'(visiting all of them: {_share(runs["visit_all_end_nodes"]):.0%})',
            _share(runs[OURS]) < _share(runs['visit_all_end_nodes']),
        ),
    ]
    return Outcome(
        'Position probability against other strategies',
        'Exploration paper, sections 3.2 and 5: claims without a figure',
        f'Worlds: {", ".join(_WORLDS)}; {_FULL.starts} random starts each, at most 0.2 m/s, '
        'exact poses, equal starts and noise. '
        '`paper` uses the position probability as the paper prints it. '
        '`position_probability` is the strategy of thinmap, with a calibrated belief. '
        'Rows without a name of a strategy are about `position_probability`; negative differences '
        'mean that it is shorter.',
        [
            Table(
                'runs',
                ['world', 'start', 'strategy', *_KEYS, 'distance_at_98'],
                [_row(r) for r in reports],
            ),
            Table('summary', _SUMMARY, summary),
        ],
        [_bars(summary), _coverage(reports)],
        comparisons,
    )


_KEYS = [
    'coverage',
    'distance',
    'time',
    'turned_rad',
    'collisions',
    'end_nodes_seen',
    'end_nodes_visited',
    'finished',
]
_SUMMARY = [
    'strategy',
    'runs',
    'complete',
    'coverage_least',
    'distance_m',
    'time_s',
    'ours_shorter_by',
    'interval_95',
]


def _reports(seed: int, setup: _Setup, name: str) -> list[Report]:
    world = world_of(name)
    reports = []
    for k in range(setup.starts):
        start = random_start(world, np.random.default_rng([seed, k]))
        for strategy in _STRATEGIES:
            options = Options(strategy=strategy, seed=seed + k, time_limit_s=setup.limit_s)
            _, report = explore(_at(world, start), start, options)
            reports.append(report | {'start_number': k})
    return reports


def _at(world: World, start: np.ndarray) -> World:
    return World(world.name, world.occupied, world.frame, start)


def _key(report: Report) -> tuple[str, int]:
    return report['world'], report['start_number']


def _row(report: Report) -> list[object]:
    return [
        *_key(report),
        report['strategy'],
        *(report[key] for key in _KEYS),
        report['distance_at'][_NEARLY],
    ]


def _summary(name: str, runs: dict[str, dict[tuple[str, int], Report]]) -> list[object]:
    mine = list(runs[name].values())
    shares = relative_saving(runs[OURS], _complete(runs[name]), 'distance')
    some = len(shares) > 1
    distance, time = (
        float(np.mean([report[key] for report in mine])) for key in ('distance', 'time')
    )
    return [
        name,
        len(mine),
        len(_complete(runs[name])),
        _least(runs[name]),
        distance,
        time,
        float(-shares.mean()) if some else None,
        half_interval_95(shares) if some else None,
    ]


def _complete(runs: dict[tuple[str, int], Report]) -> dict[tuple[str, int], Report]:
    """Runs with nearly complete coverage: a run that stops early is not more efficient."""
    return {key: report for key, report in runs.items() if report['coverage'] >= _FULL.complete}


def _comparison(other: str, runs: dict[str, dict[tuple[str, int], Report]]) -> Comparison:
    complete = _complete(runs[other])
    shares = {key: relative_saving(runs[OURS], complete, key) for key in ('distance', 'time')}
    shorter = shares['distance']
    if not len(shorter):
        return Comparison(f'against {other.replace("_", " ")}', 'more efficient', 'no complete run')
    return Comparison(
        f'against {other.replace("_", " ")}',
        'more efficient',
        f'{shorter.mean():+.0%} distance, {shares["time"].mean():+.0%} time; '
        f'shorter in {int((shorter < 0.0).sum())} of {len(shorter)}',
        bool(shorter.mean() < 0.0 and shares['time'].mean() < 0.0),
        remark=f'over its {len(shorter)} of {len(runs[other])} runs with a coverage of 95 %',
    )


def _until_nearly_all(other: str, runs: dict[str, dict[tuple[str, int], Report]]) -> Comparison:
    at = {
        name: {key: r['distance_at'][_NEARLY] for key, r in runs[name].items()}
        for name in (OURS, other)
    }
    both = [key for key in at[OURS] if at[OURS][key] and at[other].get(key)]
    shares = np.array([at[OURS][key] / at[other][key] - 1.0 for key in both])
    if not both:
        return Comparison(
            f'until 98 % coverage, against {other.replace("_", " ")}',
            'more efficient',
            'no run reached it',
        )
    return Comparison(
        f'until 98 % coverage, against {other.replace("_", " ")}',
        'more efficient',
        f'{shares.mean():+.0%} distance; shorter in {int((shares < 0.0).sum())} of {len(shares)}',
        bool(shares.mean() < 0.0),
        remark='independent of when a strategy stops',
    )


def _least(runs: dict[tuple[str, int], Report]) -> float:
    return float(min(report['coverage'] for report in runs.values()))


def _share(runs: dict[tuple[str, int], Report]) -> float:
    visited, seen = (
        sum(report[f'end_nodes_{what}'] for report in runs.values()) for what in ('visited', 'seen')
    )
    return float(visited / max(seen, 1))


def _bars(summary: Rows) -> Plot:
    names = [str(row[0]).replace('_', ' ') for row in summary]
    panels = []
    for column, label in ((4, 'distance, mean (m)'), (5, 'time, mean (s)')):
        values = np.array([float(str(row[column])) for row in summary])
        colours = [0 if row[0] == OURS else 6 for row in summary]
        panels.append(Panel([Bars(names, values, colours)], '', label, '', plan=False))
    caption = (
        'Paper 2: distance and time until the robot stops by itself, mean over worlds and starts.'
    )
    return Plot('distance', caption, panels, columns=2, panel_inches=(5.2, 3.2))


def _coverage(reports: list[Report]) -> Plot:
    """Coverage over distance; that of a world and start in shares of the mean of all strategies."""
    units: dict[tuple[str, int], float] = {}
    for key in {_key(report) for report in reports}:
        units[key] = float(
            np.mean([report['distance'] for report in reports if _key(report) == key])
        )
    shares = np.linspace(0.0, 1.5, 151)
    curves = []
    for k, name in enumerate(_STRATEGIES):
        mine = [np.array(report['curve']) for report in reports if report['strategy'] == name]
        keys = [_key(report) for report in reports if report['strategy'] == name]
        lines = [
            np.interp(shares * units[key], run[:, 1], run[:, 2])
            for key, run in zip(keys, mine, strict=True)
        ]
        mean = 100.0 * np.mean(lines, axis=0)
        style = ('-', '--', ':')[k % 3]
        curves.append(Curve(xy(shares, mean), name.replace('_', ' '), k, style, width=2.0))
    limits = (0.0, 1.5, 40.0, 101.0)
    x_label = 'distance / mean distance of all strategies'
    panel = Panel(curves, '', x_label, 'coverage (%)', plan=False, limits=limits)
    caption = 'Paper 2: coverage over distance, mean over worlds and starts.'
    return Plot('coverage', caption, [panel], panel_inches=(7.0, 4.2), legend='inside')
