"""The page of all cases, and the mean error of their worst tenth."""

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.rows import markdown
from benchmarks.scoreboard.cases import Case, LogCase
from benchmarks.scoreboard.measure import DISTURBED
from benchmarks.scoreboard.played import Numbers
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.parallel_jobs import Failure, read_report
from thinmap_ros.files.safe import read_text

MAX_ERROR_M = 10.0  # larger errors count as this
_SHORT_S = 240.0  # of the processor for the short form
_START_S = 3.0  # of the processor for a process that runs a case, before it begins
COLUMN_NOTES = """\
- *live*, *final*: error of the estimate at the time of a scan, and after all corrections. Logs:
  mean error of the reference relations; *degraded*: rms of the positions against the original log.
  Others: rms error of the position.
- *2 ms*: poses are interpolated with odometry to stamps of relations that differ by more than 2 ms.
- *aligned*: after the rigid alignment of estimated and true trajectory. Without it, the heading
  error of the first scans turns the whole map.
- *revisits*: relations of revisited places only.
- *across*: error of relations across the slip or the gap, live, from 30 m of mapped path on.
- *unmapped*: share of the scans that belong to no map that is extended; scans at rest excluded.
- *in 95 %*: share of the scans with the true position inside the 95 % ellipse.
- *sigma / rms*: root of the mean trace of the covariance divided by the rms error; 1 in a
  consistent filter.
- *overconfident*: scans with an error above 0.5 m and above 3 sigma.
- *CPU ms*: CPU time of the localizer for a scan. *longest step*: of localizer and grid, with loop
  closure and map correction.
- *peak*: highest resident memory of the process, with libraries and, for buildings, the simulator.
  *added*: without the memory before the first scan.
"""
_HEAD = """\
# SLAM: all cases

{provenance}

`python -m benchmarks.scoreboard -o DIR` generates this page.

"""
_LOGS = 'Logs'
_KINDS = {'building_': 'Buildings', 'drive_': 'Recorded drives', 'loop_': 'Closed loop'}
_REPEATED_COLUMNS = ('case', 'runs', 'live (m), mean', 'worst', 'final (m), mean', 'worst')
_COLUMNS = (
    ('live (m)', 'live_m', '.3f'),
    ('final (m)', 'final_m', '.3f'),
    ('live, 2 ms (m)', 'exact_live_m', '.3f'),
    ('final, 2 ms (m)', 'exact_final_m', '.3f'),
    ('live, aligned (m)', 'live_aligned_m', '.3f'),
    ('final, aligned (m)', 'final_aligned_m', '.3f'),
    ('live, revisits (m)', 'again_live_m', '.3f'),
    ('final, revisits (m)', 'again_final_m', '.3f'),
    ('across (m)', 'over_m', '.3f'),
    ('unmapped', 'unmapped', '.1%'),
    ('in 95 %', 'inside_95', '.0%'),
    ('sigma / rms', 'sigma_of_rms', '.1f'),
    ('overconfident', 'wrong_and_sure', 'd'),
    ('coverage', 'coverage', '.1%'),
    ('collisions', 'collisions', 'd'),
    ('CPU ms, median', 'ms_median', '.2f'),
    ('mean', 'ms_mean', '.2f'),
    ('99 %', 'ms_99', '.1f'),
    ('longest step (ms)', 'stall_ms', '.0f'),
    ('peak (MB)', 'mb', '.0f'),
    ('added (MB)', 'mb_more', '.0f'),
)


def page(cases: Sequence[Case], reports: Sequence[Numbers], made: str = '') -> str:
    """Markdown of all cases; made: line of commit and machine."""
    live = errors(cases, reports)
    order = np.argsort(-live, kind='stable')
    worst = [f'{cases[k].name} {live[k]:.2f}' for k in order[: math.ceil(0.1 * len(live))]]
    failed = [report['name'] for report in reports if 'error' in report]
    parts = [
        _HEAD.format(provenance=made) + COLUMN_NOTES,
        f'**Worst tenth, live: {worst_tenth(cases, reports):.3f} m** (mean; an error '
        f'counts as at most {MAX_ERROR_M:g} m). Its cases: {", ".join(worst)}.\n',
        'Other programs: docs/results/peers.md.\n',
        *([f'**Failed**: {", ".join(failed)}.\n'] if failed else []),
    ]
    parts.append('## Cases\n')
    parts.append(case_tables(reports, live))
    if any(case.run for case in cases):
        parts.append(_repeated(cases, reports, live))
    return '\n'.join(parts)


def kind_of(name: str) -> str:
    """Kind of the case with a name, as the pages call it."""
    return next((kind for prefix, kind in _KINDS.items() if name.startswith(prefix)), _LOGS)


def case_tables(reports: Sequence[Numbers], live: np.ndarray | None = None) -> str:
    """Markdown: a table of the cases of each kind.

    live: errors (N,), m, of logs that are judged by another one.
    """
    errors_m = [report.get('live_m', math.nan) for report in reports] if live is None else live
    parts = []
    for title in (_LOGS, *_KINDS.values()):
        rows = [k for k, report in enumerate(reports) if kind_of(report['name']) == title]
        if rows:
            parts.append(f'### {title}\n\n' + _table(rows, reports, errors_m))
    return '\n'.join(parts)


def worst_tenth(cases: Sequence[Case], reports: Sequence[Numbers]) -> float:
    """Mean of the largest tenth of the live errors, m."""
    live = np.sort(errors(cases, reports))
    return float(live[-math.ceil(0.1 * len(live)) :].mean())


def shortened(cases: Sequence[Case], reports: Sequence[Numbers]) -> str:
    """Names of the worst tenth for the short form, the worst first, one a line.

    Those that would make it much longer than two minutes on two cores are left out; the file names
    them.
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
        found.append(MAX_ERROR_M if error is None or not error < MAX_ERROR_M else error)
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


def _table(rows: list[int], reports: Sequence[Numbers], live: Sequence[float] | np.ndarray) -> str:
    columns = [
        each for each in _COLUMNS if each[1] == 'live_m' or any(each[1] in reports[k] for k in rows)
    ]
    lines = [markdown(['case', 'scans', *(title for title, _, _ in columns)], [])]
    for k in rows:
        report = reports[k]
        if 'error' in report:
            lines.append(f'| {report["name"]} | | failed: {report["error"]} |')
            continue
        cells = [_cell(report, key, form) for _, key, form in columns]
        if 'live_m' not in report:
            cells[0] = f'{live[k]:.3f} (degraded)'
        lines.append(f'| {report["name"]} | {report["scans"]} | ' + ' | '.join(cells) + ' |')
    return '\n'.join(lines) + '\n'


def _repeated(cases: Sequence[Case], reports: Sequence[Numbers], live: np.ndarray) -> str:
    """Mean and worst errors of each case that was run several times."""
    runs: dict[str, list[int]] = {}
    for k, case in enumerate(cases):
        runs.setdefault(case.first, []).append(k)
    head = [
        '## Several runs\n',
        f'In all runs but the first, odometry has noise of {1e3 * DISTURBED[0]:g} mm and '
        f'{1e3 * DISTURBED[2]:g} mrad from scan to scan. Means are geometric. In the tables and in '
        'the worst tenth each run counts as a case.\n',
    ]
    rows = []
    for name, own in runs.items():
        # A log without relations has none; a run of another that failed has the largest.
        known = any('final_m' in reports[k] for k in own)
        final = [reports[k].get('final_m', MAX_ERROR_M) for k in own] if known else []
        cells = [_mean_and_worst(metres) for metres in (live[own], np.minimum(final, MAX_ERROR_M))]
        rows.append([name, len(own), *cells])
    return '\n'.join([*head, markdown(_REPEATED_COLUMNS, rows), ''])


def _mean_and_worst(metres: np.ndarray) -> str:
    """Geometric mean of errors (N,), which one large error does not dominate, and the largest."""
    if not len(metres):
        return '|'
    mean = np.exp(np.log(np.maximum(metres, 1e-3)).mean())
    return f'{mean:.3f} | {metres.max():.3f}'


def _cell(report: Numbers, key: str, form: str) -> str:
    return format(report[key], form) if key in report else ''


_SAME = 0.05  # a change of an error by a smaller share, or by less than 5 mm, is not listed
_SAME_M = 0.005


def against(
    cases: Sequence[Case], reports: Sequence[Numbers], others: Sequence[Numbers | None]
) -> str:
    """Markdown: live errors of both runs in their common cases, those that increase first."""
    both = [k for k, other in enumerate(others) if other is not None]
    common = [cases[k] for k in both]
    ours = [reports[k] for k in both]
    theirs = [other for other in others if other is not None]
    here = errors(common, ours)
    there = errors(common, theirs)
    ratio = (here + 1e-6) / (there + 1e-6)
    lines = [
        f'## Comparison with another run ({len(both)} of {len(cases)} cases)\n',
        f'Live error: median of the ratios {np.median(ratio):.3f}; worst tenth '
        f'{worst_tenth(common, ours):.3f} m (other run {worst_tenth(common, theirs):.3f} m); '
        f'{MAX_ERROR_M:g} m or failed: {np.count_nonzero(here >= MAX_ERROR_M)} '
        f'(other run {np.count_nonzero(there >= MAX_ERROR_M)}). '
        f'Changes by more than {_SAME:.0%} and '
        f'{1000 * _SAME_M:.0f} mm:\n',
    ]
    changed = (np.abs(ratio - 1.0) > _SAME) & (np.abs(here - there) > _SAME_M)
    rows = [
        (common[k].name, f'{here[k]:.3f}', f'{there[k]:.3f}', f'{ratio[k]:.2f}')
        for k in np.argsort(-ratio, kind='stable')
        if changed[k]
    ]
    columns = ('case', 'this run (m)', 'other run (m)', 'ratio')
    return '\n'.join([*lines, markdown(columns, rows), ''])


RESULTS = 'results'
FOLDER = 'board'  # a case of the complete scoreboard may have the same name


def report_file(out: Path, name: str, folder: str = RESULTS) -> Path:
    """File of the report of a case."""
    return out / folder / f'{name}.json'


def report_of(
    out: Path, name: str, options: Numbers, failures: dict[str, Failure], folder: str = RESULTS
) -> Numbers:
    """Report of a case, or why it failed."""
    if name in failures:
        return {'name': name, 'error': failures[name].reason}
    return read_report(report_file(out, name, folder), options)


def reports_there(out: Path, cases: Sequence[Case], folder: str = RESULTS) -> list[Numbers | None]:
    """Reports of another folder, whatever its options; None for a case that is not there.

    Raises InputError where none is.
    """
    files = [report_file(out, case.name, folder) for case in cases]
    if not any(file.exists() for file in files):
        raise InputError(f'--against {out}: none of these cases has a result there')
    return [json.loads(read_text(file)) if file.exists() else None for file in files]
