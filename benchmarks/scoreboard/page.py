"""Tables of all cases, and of what has changed since another run."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.rows import markdown
from benchmarks.scoreboard.played import Numbers
from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.parallel_jobs import Failure, read_report
from thinmap_ros.files.safe import read_text

_MAX_ERROR_M = 10.0  # larger errors count as this, and a case that failed
_SAME = 0.05  # a change of an error by a smaller share, or by less than 5 mm, is not listed
_SAME_M = 0.005
COLUMN_NOTES = """\
- *live*, *final*: error of the estimate at the time of a scan, and after all corrections. Logs:
  mean error of the reference relations. Others: rms error of the position.
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
_LOGS = 'Logs'
_KINDS = {'building_': 'Buildings', 'drive_': 'Recorded drives', 'loop_': 'Closed loop'}
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


def case_tables(reports: Sequence[Numbers]) -> str:
    """Markdown: a table of the cases of each kind."""
    parts = []
    for title in (_LOGS, *_KINDS.values()):
        own = [report for report in reports if _kind_of(report['name']) == title]
        if own:
            parts.append(f'### {title}\n\n{_table(own)}\n')
    return '\n'.join(parts)


def _kind_of(name: str) -> str:
    return next((kind for prefix, kind in _KINDS.items() if name.startswith(prefix)), _LOGS)


def _table(reports: Sequence[Numbers]) -> str:
    columns = [
        each for each in _COLUMNS if each[1] == 'live_m' or any(each[1] in r for r in reports)
    ]
    rows = [_cells(report, columns) for report in reports]
    return markdown(['case', 'scans', *(title for title, _, _ in columns)], rows)


def _cells(report: Numbers, columns: Sequence[tuple[str, str, str]]) -> list[str]:
    if 'error' in report:
        return [report['name'], '', f'failed: {report["error"]}']
    known = (format(report[key], form) if key in report else '' for _, key, form in columns)
    return [report['name'], report['scans'], *known]


def against(reports: Sequence[Numbers], others: Sequence[Numbers | None]) -> str:
    """Markdown: live errors of both runs in their common cases, those that increase first."""
    pairs = [(own, other) for own, other in zip(reports, others, strict=True) if other is not None]
    here = _errors([own for own, _ in pairs])
    there = _errors([other for _, other in pairs])
    ratio = (here + 1e-6) / (there + 1e-6)
    head = (
        f'## Comparison with another run ({len(pairs)} of {len(reports)} cases)\n\n'
        f'Live error: median of the ratios {np.median(ratio):.3f}; '
        f'{_MAX_ERROR_M:g} m or failed: {np.count_nonzero(here >= _MAX_ERROR_M)} '
        f'(other run {np.count_nonzero(there >= _MAX_ERROR_M)}). '
        f'Changes by more than {_SAME:.0%} and {1000 * _SAME_M:.0f} mm:\n'
    )
    is_changed = (np.abs(ratio - 1.0) > _SAME) & (np.abs(here - there) > _SAME_M)
    rows = [
        (pairs[k][0]['name'], f'{here[k]:.3f}', f'{there[k]:.3f}', f'{ratio[k]:.2f}')
        for k in np.argsort(-ratio, kind='stable')
        if is_changed[k]
    ]
    return f'{head}\n{markdown(("case", "this run (m)", "other run (m)", "ratio"), rows)}\n'


def _errors(reports: Sequence[Numbers]) -> np.ndarray:
    """Live error of each case (N,), m, at most 10, which a failed one has; 0 without relations."""
    worst = (_MAX_ERROR_M if 'error' in report else 0.0 for report in reports)
    found = [report.get('live_m', error) for report, error in zip(reports, worst, strict=True)]
    return np.fmin(found, _MAX_ERROR_M)


FOLDER = 'board'


def report_file(out: Path, name: str) -> Path:
    """File of the report of a case."""
    return out / FOLDER / f'{name}.json'


def report_of(out: Path, name: str, options: Numbers, failures: dict[str, Failure]) -> Numbers:
    """Report of a case, or why it failed."""
    if name in failures:
        return {'name': name, 'error': failures[name].reason}
    return read_report(report_file(out, name), options)


def reports_there(out: Path, names: Sequence[str]) -> list[Numbers | None]:
    """Reports of another folder, whatever its options; None for a case that is not there.

    Raises InputError where none is.
    """
    files = [report_file(out, name) for name in names]
    if not any(file.exists() for file in files):
        raise InputError(f'--against {out}: none of these cases has a result there')
    return [json.loads(read_text(file)) if file.exists() else None for file in files]
