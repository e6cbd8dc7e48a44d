"""The scoreboard's page, and the one number for its worst tenth."""

import math
from collections.abc import Sequence

import numpy as np

from benchmarks.scoreboard.cases import BuildingCase, Case, DriveCase, LogCase, LoopCase
from benchmarks.scoreboard.measure import DISTURBED
from benchmarks.scoreboard.played import Numbers
from thinmap_ros.core import se2

MOST_M = 10.0  # an error beyond says no more
_SHORT_S = 240.0  # of the processor for the short form
_START_S = 3.0  # of the processor for a process that runs a case, before it begins
_PEERS = """\
Peers on the same logs, final or live = final, m: IRIS LaMa intel 0.047, aces 0.046, csail 1.09,
fhw 0.75; published, Cartographer: intel_raw 0.023, aces_raw 0.038, csail_raw 0.032.
"""
_HEAD = """\
# Scoreboard

Made by `python -m benchmarks.scoreboard -o DIR`. Logs: mean error of the known relations, m;
`ours`: against the undegraded run of a log without relations (rms of positions). Buildings: rms
error of the position, m; *aligned*: after the rigid motion that lays the path onto the true one
best, as a first look without walls can turn the whole map.

*2 ms*: poses moved along the odometry to stamps of relations that are more than 2 ms off. *again*:
relations of revisits alone. *over*: error of relations that span the slip or the gap, live, from
30 m of known ground on. *unmapped*: share of scans whose pose belongs to no map that is being
extended, standing scans aside. *in 95 %*: share of scans whose true position is in the 95 %
ellipse. *sigma / rms*: root of the mean trace of the covariance over the rms error, both of scans
that are not lost, 1 where it is right. *wrong and sure*: scans with an error above 0.5 m and
3 sigma below it. *ms*: CPU time a scan of the localizer. *stall*: longest step of localizer and
grid, with loop closing and all that is made anew after it, CPU time. *peak MB*: highest resident
memory of the process, libraries and, for buildings, the simulated drive included. *MB more*: that
without what the process held before the first scan.
"""
_KINDS = (
    ('Logs', LogCase),
    ('Buildings', BuildingCase),
    ('Recorded drives', DriveCase),
    ('Closed loop', LoopCase),
)
_COLUMNS = (
    ('live', 'live_m', '.3f'),
    ('final', 'final_m', '.3f'),
    ('live 2 ms', 'exact_live_m', '.3f'),
    ('final 2 ms', 'exact_final_m', '.3f'),
    ('aligned live', 'live_aligned_m', '.3f'),
    ('aligned final', 'final_aligned_m', '.3f'),
    ('again live', 'again_live_m', '.3f'),
    ('again final', 'again_final_m', '.3f'),
    ('over', 'over_m', '.3f'),
    ('unmapped', 'unmapped', '.1%'),
    ('in 95 %', 'inside_95', '.0%'),
    ('sigma / rms', 'sigma_of_rms', '.1f'),
    ('wrong and sure', 'wrong_and_sure', 'd'),
    ('coverage', 'coverage', '.1%'),
    ('collisions', 'collisions', 'd'),
    ('ms median', 'ms_median', '.2f'),
    ('mean', 'ms_mean', '.2f'),
    ('99 %', 'ms_99', '.1f'),
    ('stall ms', 'stall_ms', '.0f'),
    ('peak MB', 'mb', '.0f'),
    ('MB more', 'mb_more', '.0f'),
)


def page(cases: Sequence[Case], reports: Sequence[Numbers]) -> str:
    """Markdown of all cases, the worst ones first named."""
    live = errors(cases, reports)
    order = np.argsort(-live, kind='stable')
    worst = [f'{cases[k].name} {live[k]:.2f}' for k in order[: math.ceil(0.1 * len(live))]]
    failed = [report['name'] for report in reports if 'error' in report]
    parts = [
        _HEAD,
        f'**Worst tenth, live: {worst_tenth(cases, reports):.3f} m** (mean; an error '
        f'counts as at most {MOST_M:g} m). It is: {", ".join(worst)}.\n',
        _PEERS,
        *([f'**Failed**: {", ".join(failed)}.\n'] if failed else []),
    ]
    parts.append(case_tables(cases, reports))
    if any(case.run for case in cases):
        parts.append(_repeated(cases, reports, live))
    return '\n'.join(parts)


def case_tables(cases: Sequence[Case], reports: Sequence[Numbers]) -> str:
    """Markdown: a table of the cases of each kind."""
    live = errors(cases, reports)
    parts = []
    for title, kind in _KINDS:
        rows = [k for k, case in enumerate(cases) if isinstance(case, kind)]
        if rows:
            parts.append(f'## {title}\n\n' + _table(rows, cases, reports, live))
    return '\n'.join(parts)


def worst_tenth(cases: Sequence[Case], reports: Sequence[Numbers]) -> float:
    """Mean of the largest tenth of the live errors, m."""
    live = np.sort(errors(cases, reports))
    return float(live[-math.ceil(0.1 * len(live)) :].mean())


def shortened(cases: Sequence[Case], reports: Sequence[Numbers]) -> str:
    """Names of the worst tenth for the short form, the worst first, one a line.

    Those that would make it much longer than two minutes on two cores are left out, and said to be.
    """
    live = errors(cases, reports)
    lines = [
        '# Written by `python -m benchmarks.scoreboard -o DIR --write-short`: the worst tenth.'
    ]
    left_s = _SHORT_S
    for k in np.argsort(-live, kind='stable')[: math.ceil(0.1 * len(live))]:
        taken_s = reports[k]['cpu_s'] + _START_S
        left_out = taken_s > left_s
        left_s -= 0.0 if left_out else taken_s
        name = cases[k].name
        lines.append(f'# too long, {taken_s:.0f} s: {name}' if left_out else name)
    return '\n'.join(lines) + '\n'


def errors(cases: Sequence[Case], reports: Sequence[Numbers]) -> np.ndarray:
    """Live error of each case (N,), m, at most 10, which a failed one has.

    0 for a log without relations: its degraded versions are compared with it.
    """
    paths = {report['name']: report['path'] for report in reports if 'path' in report}
    found = []
    for case, report in zip(cases, reports, strict=True):
        error = report.get('live_m')
        if 'path' in report and isinstance(case, LogCase):
            error = _against(paths.get(case.log), report['path'])
        found.append(MOST_M if error is None or not error < MOST_M else error)
    return np.array(found)


def _against(own: list[list[float]] | None, path: list[list[float]]) -> float:
    """Rms of positions against those of another run at the same stamps, both from their first."""
    if own is None:
        return math.nan
    known = {stamp: pose for stamp, *pose in own}
    pairs = [(known[stamp], pose) for stamp, *pose in path if stamp in known]
    if not pairs:
        return math.nan
    first, second = (np.array(side) for side in zip(*pairs, strict=True))
    off = [
        se2.between(first[0], a)[:2] - se2.between(second[0], b)[:2]
        for a, b in zip(first, second, strict=True)
    ]
    return float(np.sqrt((np.array(off) ** 2).sum(axis=1).mean()))


def _table(
    rows: list[int], cases: Sequence[Case], reports: Sequence[Numbers], live: np.ndarray
) -> str:
    columns = [
        each for each in _COLUMNS if each[1] == 'live_m' or any(each[1] in reports[k] for k in rows)
    ]
    lines = ['| case | scans | ' + ' | '.join(title for title, _, _ in columns) + ' |']
    lines.append('|---' * (len(columns) + 2) + '|')
    for k in rows:
        report = reports[k]
        if 'error' in report:
            lines.append(f'| {report["name"]} | | failed: {report["error"]} |')
            continue
        cells = [_cell(report, key, form) for _, key, form in columns]
        if 'live_m' not in report:
            cells[0] = f'{live[k]:.3f} (ours)'
        lines.append(f'| {report["name"]} | {report["scans"]} | ' + ' | '.join(cells) + ' |')
    return '\n'.join(lines) + '\n'


def _repeated(cases: Sequence[Case], reports: Sequence[Numbers], live: np.ndarray) -> str:
    """Mean and worst errors of each case that was run several times."""
    runs: dict[str, list[int]] = {}
    for k, case in enumerate(cases):
        runs.setdefault(case.first, []).append(k)
    lines = [
        '## Several runs\n',
        f'All but the first with odometry disturbed by {1e3 * DISTURBED[0]:g} mm and '
        f'{1e3 * DISTURBED[2]:g} mrad from scan to scan; mean: geometric. In the tables and in the '
        'worst tenth each run counts as a case.\n',
        '| case | runs | live, mean | worst | final, mean | worst |',
        '|---|---|---|---|---|---|',
    ]
    for name, own in runs.items():
        # A log without relations has none; a run of another that failed has the largest.
        known = any('final_m' in reports[k] for k in own)
        final = [reports[k].get('final_m', MOST_M) for k in own] if known else []
        cells = [_mean_and_worst(metres) for metres in (live[own], np.minimum(final, MOST_M))]
        lines.append(f'| {name} | {len(own)} | ' + ' | '.join(cells) + ' |')
    return '\n'.join(lines) + '\n'


def _mean_and_worst(metres: np.ndarray) -> str:
    """Geometric mean of errors (N,), as one far worse would hide the others, and the largest."""
    if not len(metres):
        return '|'
    mean = np.exp(np.log(np.maximum(metres, 1e-3)).mean())
    return f'{mean:.3f} | {metres.max():.3f}'


def _cell(report: Numbers, key: str, form: str) -> str:
    return format(report[key], form) if key in report else ''
