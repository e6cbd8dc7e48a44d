"""The cases of the board, and what is asked of logs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from benchmarks.rows import markdown
from benchmarks.scoreboard.cases import (
    BUILDINGS,
    ROBOTS,
    BuildingCase,
    Case,
    DriveCase,
    LogCase,
    LoopCase,
    all_cases,
    repeated,
)
from benchmarks.scoreboard.played import Numbers
from thinmap_ros.core.errors import InputError

LARGEST = 'kth/50037764_PLAN1'
KTH = ('kth/50052748', 'kth/50052749', 'kth/50052751', LARGEST)
WORLDS = (*KTH, 'dungeon/d1573', 'dungeon/d114')
_ODOMETRY_SEEDS = (1, 2, 3, 4)
_LOOP_SEEDS = (1, 3)
OTHER_LASERS = ('turtlebot3', 'rplidar_a1')
_OTHER_WORLDS = ('office', 'lab', 'kth/50052751')
RUNS = 5
# Asked of the mean error of a log's relations, live, m.
ASKED_OF_LOGS = {
    'intel': 0.046,
    'intel_sparse': 0.057,
    'intel_raw': 0.022,
    'csail': 0.036,
    'csail_raw': 0.029,
    'aces_raw': 0.043,
}
ASKED_OF_REPEATED = {'fhw': 0.058, 'aces': 0.052}
ASKED_OF_DEGRADED = {
    'aces_raw.turn_noise_0.15': 0.06,
    'fhw.half_blind': 0.08,
    'csail_raw.no_odometry': 0.03,
    'intel_raw.slip': 0.03,
    'intel_raw.no_odometry': 0.05,
    'intel.range_8m': 0.05,
    'aces.range_8m': 0.10,
}


def board_cases(logs: Path) -> list[Case]:
    """All cases of the board, those that take longest first.

    logs: a folder with NAME/log.clf or log.clf.gz; those that are missing are left out.
    Raises InputError where there is no log.
    """
    cases: list[Case] = [LoopCase(world, seed) for world in KTH for seed in _LOOP_SEEDS]
    cases += [LoopCase(_OTHER_WORLDS[-1], _LOOP_SEEDS[0], laser) for laser in OTHER_LASERS]
    known = {case.name: case for case in all_cases(logs) if isinstance(case, LogCase)}
    names = ('intel_raw.no_odometry', 'intel_raw.slip', *ASKED_OF_LOGS, *ASKED_OF_DEGRADED)
    cases += [known[name] for name in dict.fromkeys(names) if name in known]
    again = [known[name] for name in ASKED_OF_REPEATED if name in known]
    cases += repeated(again, RUNS)
    cases += [DriveCase(world, seed) for world in WORLDS for seed in _ODOMETRY_SEEDS]
    cases += [LoopCase(world, seed) for world in WORLDS[len(KTH) :] for seed in _LOOP_SEEDS]
    cases += [BuildingCase(seed, robot, 1.0) for seed in BUILDINGS for robot in ROBOTS]
    cases += [
        LoopCase(world, _LOOP_SEEDS[0], laser)
        for world in _OTHER_WORLDS[:-1]
        for laser in OTHER_LASERS
    ]
    return cases


_SIMULATED = ('drive_*', 'loop_*', 'building_*')
Found = Sequence[Numbers]
Judge = Callable[[Found], tuple[str, bool]]


@dataclass(frozen=True)
class Row:
    """Target for some cases; patterns: of their names; judge: measured value, and if it is met.

    judge has the reports of those cases that were measured, at least one.
    """

    title: str
    patterns: tuple[str, ...]
    asked: str
    judge: Judge


def board_rows() -> list[Row]:
    """All rows of the board's table."""
    loops = ('loop_*.lms200_*',)
    others = tuple(f'loop_*.{laser}_*' for laser in OTHER_LASERS)
    rows = [
        Row(
            'recorded drives, live, m: median / worst',
            ('drive_*',),
            *_median_and_worst('live_m', 0.08, 0.15),
        ),
        Row(
            'recorded drives, final, m: median / worst',
            ('drive_*',),
            *_median_and_worst('final_m', 0.08, 0.15),
        ),
        Row('closed loop, pose error, m: worst', loops, *_at_most('live_m', 0.12)),
        Row('closed loop, coverage of all but the largest floor: least', loops, *_coverage(0.98)),
        Row('closed loop, collisions: sum', loops, *_sum('collisions')),
        Row('closed loop, other lasers, pose error, m: worst', others, *_at_most('live_m', 0.15)),
        Row(
            'buildings, live after alignment, m: median / worst tenth',
            ('building_*',),
            *_median_and_worst_tenth('live_aligned_m', 0.10, 0.40),
        ),
    ]
    for name, asked in ASKED_OF_LOGS.items():
        rows.append(Row(f'{name}, live, m', (name,), *_at_most('live_m', asked, named=False)))
    for name, asked in ASKED_OF_REPEATED.items():
        title = f'{name}, live, m: mean / worst of {RUNS} runs'
        rows.append(Row(title, (name, f'{name}.run_*'), *_mean_and_worst('live_m', asked)))
    for name, asked in ASKED_OF_DEGRADED.items():
        rows.append(Row(f'{name}, live, m', (name,), *_at_most('live_m', asked, named=False)))
    return rows + _rows_of_time() + _rows_of_covariance()


def board_table(
    reports: Sequence[Numbers],
    names: Sequence[str],
    others: Sequence[Numbers | None] | None = None,
) -> str:
    """Markdown table of all rows with a case among the reports.

    names: of all cases of the board; others: reports of the same cases elsewhere, if any.
    """
    heads = ['quantity', 'target', 'measured', '', *(['other run'] if others is not None else [])]
    lines = []
    measured = [report['name'] for report in reports]
    for row in board_rows():
        own = cases_of(row, measured)
        if not own:
            continue
        cells = _cells(row, [reports[k] for k in own], len(cases_of(row, names)))
        if others is not None:
            there = [others[k] for k in own]
            known = [other for other in there if other is not None]
            cells.append(_cells(row, known, len(own))[2] if known else '')
        lines.append(cells)
    return markdown(heads, lines) + '\n'


def _cells(row: Row, own: Found, count: int) -> list[str]:
    """Title, target, value measured in some of so many cases, and verdict."""
    found = [report for report in own if 'error' not in report]
    text, is_met = row.judge(found) if found else ('', False)
    notes = []
    if len(found) < len(own):
        notes.append(f'{len(own) - len(found)} failed')
        is_met = False
    if len(own) < count:
        notes.append(f'{len(own)} of {count} cases')
    if notes:
        text = f'{text} [{", ".join(notes)}]'.lstrip()
    return [row.title, row.asked, text, 'met' if is_met else '**missed**']


def cases_of(row: Row, names: Sequence[str]) -> list[int]:
    """Which of the cases with these names a row is about."""
    return [
        k for k, name in enumerate(names) if any(fnmatch(name, pattern) for pattern in row.patterns)
    ]


def _rows_of_time() -> list[Row]:
    return [
        Row('intel_raw, CPU ms a scan: mean', ('intel_raw',), *_mean('ms_mean', 0.9)),
        Row('csail, CPU ms a scan: mean', ('csail',), *_mean('ms_mean', 5.0)),
        Row('kth drives, CPU ms a scan: mean', ('drive_kth_*',), *_mean('ms_mean', 1.2)),
        Row('intel_raw, CPU ms a scan: 99 %', ('intel_raw',), *_mean('ms_99', 8.0)),
        Row(
            'longest step of localizer and grid, corrections included, CPU ms',
            ('*',),
            *_at_most('step_ms', 60.0, form='.0f'),
        ),
    ]


def _rows_of_covariance() -> list[Row]:
    return [
        Row('simulated: share in the 95 % ellipse: least / median', _SIMULATED, *_inside(0.85)),
        Row('simulated: overconfident scans: sum', _SIMULATED, *_sum('wrong_and_sure')),
    ]


def _at_most(key: str, asked: float, form: str = '.3f', named: bool = True) -> tuple[str, Judge]:
    def judge(found: Found) -> tuple[str, bool]:
        value, name = _worst(found, key)
        return f'{value:{form}}' + (f' ({name})' if named else ''), _is_within(value, asked)

    return f'{asked:g}', judge


def _mean(key: str, asked: float) -> tuple[str, Judge]:
    def judge(found: Found) -> tuple[str, bool]:
        value = float(_values(found, key).mean())
        return f'{value:.2f}', _is_within(value, asked)

    return f'{asked:g}', judge


def _median_and_worst(key: str, asked: float, asked_worst: float) -> tuple[str, Judge]:
    def judge(found: Found) -> tuple[str, bool]:
        median = float(np.median(_values(found, key)))
        value, name = _worst(found, key)
        is_met = _is_within(median, asked) and _is_within(value, asked_worst)
        return f'{median:.3f} / {value:.3f} ({name})', is_met

    return f'{asked:g} / {asked_worst:g}', judge


def _median_and_worst_tenth(key: str, asked: float, asked_tenth: float) -> tuple[str, Judge]:
    def judge(found: Found) -> tuple[str, bool]:
        values = np.sort(_values(found, key))
        median = float(np.median(values))
        tenth = float(values[-max(1, round(0.1 * len(values))) :].mean())
        _, name = _worst(found, key)
        text = f'{median:.3f} / {tenth:.3f} (worst: {name})'
        return text, _is_within(median, asked) and _is_within(tenth, asked_tenth)

    return f'{asked:g} / {asked_tenth:g}', judge


def _mean_and_worst(key: str, asked: float) -> tuple[str, Judge]:
    def judge(found: Found) -> tuple[str, bool]:
        values = _values(found, key)
        text = f'{values.mean():.3f} / {values.max():.3f}'
        return text, _is_within(float(values.max()), asked)

    return f'{asked:g}', judge


def _coverage(asked: float) -> tuple[str, Judge]:
    def judge(found: Found) -> tuple[str, bool]:
        # An exploration that ends at its time limit has none.
        whole = [report for report in found if 'coverage' in report]
        if not whole:
            return 'no complete run', True
        least = min(whole, key=lambda report: float(report['coverage']))
        is_met = _is_within(asked, float(least['coverage']))
        return f'{least["coverage"]:.1%} ({least["name"]})', is_met

    return f'{asked:.0%}', judge


def _inside(asked: float) -> tuple[str, Judge]:
    def judge(found: Found) -> tuple[str, bool]:
        values = _values(found, 'inside_95')
        least = found[int(np.argmin(values))]['name']
        text = f'{values.min():.1%} ({least}) / {np.median(values):.1%}'
        return text, _is_within(asked, float(values.min()))

    return f'{asked:.0%}', judge


def _sum(key: str) -> tuple[str, Judge]:
    def judge(found: Found) -> tuple[str, bool]:
        total = int(_values(found, key).sum())
        _, name = _worst(found, key)
        return f'{total}' + (f' (most: {name})' if total else ''), total == 0

    return '0', judge


def _is_within(value: float, limit: float) -> bool:
    """Whether a value is at most a limit, both as they are printed."""
    return round(value, 3) <= limit


def _values(found: Found, key: str) -> np.ndarray:
    for report in found:
        if key not in report:
            raise InputError(f'{report["name"]}: no {key} in its result: expected another folder')
    return np.array([report[key] for report in found], dtype=np.float64)


def _worst(found: Found, key: str) -> tuple[float, str]:
    values = _values(found, key)
    worst = int(np.argmax(values))
    return float(values[worst]), found[worst]['name']
