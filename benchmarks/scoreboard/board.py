"""The cases of the board, and what is asked of them: targets.csv, a row of its table each.

limits: of statistics of the values of `key`; text: what is shown of them; without: what is shown
where no case has the key, which it must have else.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from benchmarks.rows import markdown, read_cases
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
_OTHER_LASERS = ('turtlebot3', 'rplidar_a1')
_OTHER_WORLDS = ('office', 'lab', 'kth/50052751')
_RUNS = 5
_RUN = '.run_*'
Found = Sequence[Numbers]


@dataclass(frozen=True)
class Row:
    """Target for some cases, by patterns of their names, as in targets.csv."""

    title: str
    patterns: tuple[str, ...]
    key: str
    target: str
    limits: tuple[str, ...]
    text: str
    without: str = ''

    def judge(self, found: Found) -> tuple[str, bool]:
        """Measured value, and whether the target is met, of reports: at least one.

        Raises InputError where one of them lacks the value.
        """
        known = [report for report in found if self.key in report or not self.without]
        if not known:
            return self.without, True
        statistics = _statistics(known, self.key)
        limits = dict(zip(self.limits[::2], map(float, self.limits[1::2]), strict=True))
        is_met = all(_is_met(name, statistics[name], limit) for name, limit in limits.items())
        most = f' (most: {statistics["worst_case"]})' if statistics['sum'] else ''
        return self.text.format(**statistics, most=most), is_met


def board_rows() -> list[Row]:
    """All rows of the board's table."""
    return read_cases(Path(__file__).with_name('targets.csv'), Row)


def board_cases(logs: Path) -> list[Case]:
    """All cases of the board, those that take longest first.

    logs: a folder with NAME/log.clf or log.clf.gz; those that are missing are left out.
    Raises InputError where there is no log.
    """
    cases: list[Case] = [LoopCase(world, seed) for world in KTH for seed in _LOOP_SEEDS]
    cases += [LoopCase(_OTHER_WORLDS[-1], _LOOP_SEEDS[0], laser) for laser in _OTHER_LASERS]
    named = {pattern for row in board_rows() for pattern in row.patterns}
    for case in all_cases(logs):
        if isinstance(case, LogCase) and case.name in named:
            cases += repeated([case], _RUNS if case.name + _RUN in named else 1)
    cases += [DriveCase(world, seed) for world in WORLDS for seed in _ODOMETRY_SEEDS]
    cases += [LoopCase(world, seed) for world in WORLDS[len(KTH) :] for seed in _LOOP_SEEDS]
    cases += [BuildingCase(seed, robot, 1.0) for seed in BUILDINGS for robot in ROBOTS]
    cases += [
        LoopCase(world, _LOOP_SEEDS[0], laser)
        for world in _OTHER_WORLDS[:-1]
        for laser in _OTHER_LASERS
    ]
    return cases


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
    return [row.title, row.target, text, 'met' if is_met else '**missed**']


def cases_of(row: Row, names: Sequence[str]) -> list[int]:
    """Which of the cases with these names a row is about."""
    return [
        k for k, name in enumerate(names) if any(fnmatch(name, pattern) for pattern in row.patterns)
    ]


def _statistics(found: Found, key: str) -> Numbers:
    """Statistics of a value, by name, and the cases with the largest and the smallest one."""
    for report in found:
        if key not in report:
            raise InputError(f'{report["name"]}: no {key} in its result: expected another folder')
    values = np.array([report[key] for report in found], dtype=np.float64)
    ordered = np.sort(values)
    return {
        'mean': float(values.mean()),
        'median': float(np.median(values)),
        'worst': float(ordered[-1]),
        'tenth': float(ordered[-max(1, round(0.1 * len(values))) :].mean()),
        'least': float(ordered[0]),
        'sum': float(values.sum()),
        'worst_case': found[int(values.argmax())]['name'],
        'least_case': found[int(values.argmin())]['name'],
    }


def _is_met(statistic: str, value: float, limit: float) -> bool:
    """Whether a value is at most a limit, or at least if it is the least, as they are printed."""
    return value >= limit if statistic == 'least' else round(value, 3) <= limit
