"""Reports of many explorations, paired by world and start, as one table."""

from collections import defaultdict
from typing import Any

import numpy as np
from scipy.special import stdtrit

from thinmap_ros.core.se2 import Array

Report = dict[str, Any]
OURS = 'position_probability'
_UPPER_95 = 0.975  # two-sided
_COMPLETE = 0.95  # coverage below which a path is short because much is missing


def markdown(reports: list[Report]) -> str:
    """Tables of means (and spread over runs) by strategy, and of paired relative savings."""
    runs_of = by_strategy(reports)
    lines = [
        '| strategy | runs | stopped by itself | coverage, least / mean | collisions '
        '| distance (m) | time (s) | turns (rad) | reversals per 100 m | decision (ms) '
        '| times real time |',
        '|---|---|---|---|---|---|---|---|---|---|---|',
    ]
    lines += [_row(name, list(runs.values())) for name, runs in sorted(runs_of.items())]
    others = sorted(set(runs_of) - {OURS})
    if OURS in runs_of and others:
        lines += [
            '',
            f'Difference of {OURS} to each other strategy, paired by world and start, where both '
            f'covered at least {_COMPLETE:.0%} (mean and 95 % confidence interval; negative: it is '
            'shorter):',
            '',
            '| against | pairs | distance | time | turns | shorter distance in |',
            '|---|---|---|---|---|---|',
        ]
        lines += [_paired(name, runs_of[OURS], runs_of[name]) for name in others]
    return '\n'.join(lines) + '\n'


def by_strategy(reports: list[Report]) -> dict[str, dict[tuple[str, int], Report]]:
    """Reports by strategy, and by world and number of the start."""
    found: dict[str, dict[tuple[str, int], Report]] = defaultdict(dict)
    for report in reports:
        found[report['strategy']][report['world'], report['start_number']] = report
    return dict(found)


def relative_saving(
    ours: dict[tuple[str, int], Report], others: dict[tuple[str, int], Report], key: str
) -> Array:
    """Ours / other - 1 of a quantity, (N,), for each world and start that both have covered."""
    common = sorted(
        pair
        for pair in ours.keys() & others.keys()
        if min(ours[pair]['coverage'], others[pair]['coverage']) >= _COMPLETE
    )
    return np.array([ours[pair][key] / others[pair][key] - 1.0 for pair in common])


def half_interval_95(values: Array) -> float:
    """Half the width of the 95 % confidence interval of the mean of two or more values (N,).

    By Student's t: few values say little about their own spread.
    """
    quantile = stdtrit(len(values) - 1, _UPPER_95)
    return float(quantile * values.std(ddof=1) / np.sqrt(len(values)))


def _row(name: str, runs: list[Report]) -> str:
    coverage = [run['coverage'] for run in runs]
    speed = sum(run['time'] for run in runs) / max(sum(run['cpu_s'] for run in runs), 1e-9)
    decision_ms = float(np.median([run['decision_ms']['median'] for run in runs]))
    return (
        f'| {name} | {len(runs)} | {sum(run["finished"] for run in runs)} '
        f'| {min(coverage):.2%} / {np.mean(coverage):.2%} '
        f'| {sum(run["collisions"] for run in runs)} '
        f'| {_spread(runs, "distance")} | {_spread(runs, "time")} | {_spread(runs, "turned_rad")} '
        f'| {_reversals(runs)} | {decision_ms:.2f} | {speed:.0f} |'
    )


def _reversals(runs: list[Report]) -> str:
    """Returns to the target before the last per 100 m; empty for reports without them."""
    if any('reversals' not in run for run in runs):
        return ''
    driven_m = sum(run['distance'] for run in runs)
    return f'{100.0 * sum(run["reversals"] for run in runs) / max(driven_m, 1e-9):.1f}'


def _spread(runs: list[Report], key: str) -> str:
    """Mean of a quantity, and the mean over worlds of its standard deviation over starts."""
    by_world: dict[str, list[float]] = defaultdict(list)
    for run in runs:
        by_world[run['world']].append(run[key])
    spread = np.mean([np.std(values) for values in by_world.values()])
    return f'{np.mean([run[key] for run in runs]):.1f} ± {spread:.1f}'


def _paired(
    name: str, ours: dict[tuple[str, int], Report], others: dict[tuple[str, int], Report]
) -> str:
    shares = {key: relative_saving(ours, others, key) for key in ('distance', 'time', 'turned_rad')}
    cells = []
    for values in shares.values():
        half = f' ± {half_interval_95(values):.1%}' if len(values) > 1 else ''
        cells.append(f'{values.mean():+.1%}{half}' if len(values) else '')
    distances = shares['distance']
    return (
        f'| {name} | {len(distances)} | '
        + ' | '.join(cells)
        + f' | {int((distances < 0.0).sum())} |'
    )
