"""Make docs/results/slam.md and its chart from the results of the board.

Usage: python -m benchmarks.scoreboard.results_page DIR [DOCS].
"""

import json
from collections.abc import Sequence
from pathlib import Path

from benchmarks.charts import (
    OTHERS,
    OURS,
    Mark,
    Panel,
    page_program,
    picture,
    span,
    write_page,
)
from benchmarks.rows import markdown, read_rows
from benchmarks.scoreboard.page import COLUMN_NOTES, FOLDER, case_tables
from benchmarks.scoreboard.played import Numbers
from benchmarks.scoreboard.stamps import NAME as STAMPS
from benchmarks.scoreboard.stamps import THINNED
from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation import slam_run
from thinmap_ros.evaluation.parallel_jobs import provenance
from thinmap_ros.evaluation.slam_run import CARTOGRAPHER, COMPLETE, INTEL, LAMA, Origin, shown
from thinmap_ros.files.safe import read_text

_CHART = 'slam'
_NAMES = {
    'intel_raw': 'Intel Research Lab',
    'aces_raw': 'ACES, Austin',
    'csail_raw': 'MIT CSAIL',
}
_COMPLETE_COLUMNS = (
    'log',
    'thinmap, live (m)',
    'thinmap, final (m)',
    'Cartographer, final (m)',
    'graph mapping, final (m)',
    'IRIS LaMa (m)',
)
_INTEL_COLUMNS = (
    'program',
    'live (m)',
    'final (m)',
    'CPU time per scan, mean (ms)',
    'memory (MB)',
    'source',
)
_INTEL_FORMS = {'live_m': '.3f', 'final_m': '.3f', 'ms_mean': '.2f', 'mb': '.0f'}
_HEAD = """\
# SLAM: accuracy

{made}

{chart}
Errors are means over the reference relations of the SLAM benchmark, translation. *Live*: the pose
at the time of a scan, which a robot drives by. *Final*: after all corrections. thinmap corrects
live poses, too, so that both are close. [Peers](peers.md) lists the programs with their versions,
settings and sources; [Targets](../development/targets.md) compares thinmap with the targets of the
project.

`python -m benchmarks release` generates this page.

"""
_COMPLETE_NOTES = """\
Cartographer and graph mapping: as published, final poses; compare them with thinmap's final poses.
IRIS LaMa closes no loops: one error is recorded for each log, and it loses all three.

"""
_INTEL_NOTES = """\
Compare times with care: the machines of the other programs are not recorded, and one release of
thinmap takes twice as long on one machine as on another. [On one machine](peers.md), IRIS LaMa
takes about a tenth of thinmap's time for a scan that it processes. It takes a twentieth of the
memory and is about as exact: better in its first build, worse in its third. slam_toolbox takes less
time, and Karto and IRIS LaMa have the smaller final errors. Cartographer was tuned by hand for this
log; its published 0.023 m are final poses of the complete log, so that 0.081 m is what to compare.

"""
_WHY = """\
## Why the same laboratory has {complete:.3f} m and {thinned:.3f} m

Both logs are of one drive, and the same 2,984 relations judge both. The complete log has a scan at
both stamps of each relation. The log of 5,438 scans has one at both stamps of 852 relations. For
the others, the pose of a scan up to 0.1 s away counts as the pose at the stamp, while the robot
moves; farther stamps are reached with the odometry of the wheels. The live poses, judged in other
ways:

"""
_WHY_END = """
So the difference is a matter of stamps, not of poses: the poses of the complete log, judged only
at the scans of the thinned one, are as far off as those of the thinned log. Relations with a scan
at both stamps are no random choice; compare values of one row. All programs of the table of 5,438
scans are judged with the same stamps: their errors compare with each other, but not with those of
the complete log. `python -m benchmarks.scoreboard.stamps` computes this table.

"""
_CASES = """\
## All cases

Names of cases:

- *Logs*: `intel` (5,438 scans), `intel_sparse` (half of them), `aces`, `csail` and `fhw` (a museum)
  are published, thinned logs; `_raw` marks a complete one. After the dot: what was made worse, such
  as `slip`, `range_8m`, `no_odometry`, or the number of a run with other noise.
- *Buildings*: `building_SEED.ROBOT_xNOISE`, drives of some 250 m in generated buildings with
  furniture and people, by a Pioneer 2-DX or 3-AT.
- *Recorded drives*: `drive_WORLD.odometry_SEED`, the first 20 minutes of an exploration (up to
  6,000 scans), replayed with other odometry noise. `kth`: real floors of a university; `dungeon`:
  random worlds of 50 x 50 m.
- *Closed loop*: `loop_WORLD.LASER_SEED`, explorations that drive by the estimated pose.

Columns:

"""


def read_reports(folder: Path) -> list[Numbers]:
    """Reports of all finished cases of a folder of the board.

    Raises InputError where there is none.
    """
    files = sorted((folder / FOLDER).glob('*.json'))
    if not files:
        raise InputError(f'{folder / FOLDER}: no results of the board: expected NAME.json')
    return [json.loads(read_text(file)) for file in files]


def write(folder: Path, docs: Path) -> Path:
    """Write the page of a folder of the board, and its chart. Returns its path."""
    reports = read_reports(folder)
    made = provenance(folder)
    for report in reports:
        report.setdefault('made', made)
    text = page(reports, _stamps(folder))
    return write_page(docs / 'results' / f'{_CHART}.md', text, _panels(reports), _KEYS, columns=2)


def page(reports: Sequence[Numbers], stamps: Sequence[Sequence[str]] = ()) -> str:
    """Text of the page; stamps: rows of stamps.csv, what and value."""
    caption = 'Mean error on public logs, beside other programs (smaller is better).'
    parts = [
        _HEAD.format(made=made_lines(reports), chart=picture(_CHART, caption)),
        *_complete_table(reports),
        *_intel_table(reports),
        *_why(reports, stamps),
        _CASES + COLUMN_NOTES + '\n',
        case_tables(reports),
    ]
    return ''.join(parts)


def made_lines(reports: Sequence[Numbers]) -> str:
    """A line of commit and machine; with several, one for each, with the names of its cases.

    The most frequent one is that of all cases that are not named.
    """
    names: dict[str, list[str]] = {}
    for report in reports:
        names.setdefault(report['made'], []).append(f'`{report["name"]}`')
    most = max(names, key=lambda made: len(names[made]))
    lines = [f'- {", ".join(names[made])}: {made}' for made in names if made != most]
    return '\n'.join([*lines, f'- all other cases: {most}']) if lines else most


def _by_name(reports: Sequence[Numbers]) -> dict[str, Numbers]:
    return {report['name']: report for report in reports if 'live_m' in report}


def _peer(system: str, log: str, origin: Origin) -> slam_run.PeerRun | None:
    found = [run for run in slam_run.runs(log) if (run.system, run.origin) == (system, origin)]
    return found[0] if found else None


def _complete_table(reports: Sequence[Numbers]) -> list[str]:
    known = _by_name(reports)
    names = [name for name in COMPLETE if name in known]
    if not names:
        return []
    rows = []
    for name in names:
        published = [
            _peer(system, name, Origin.PUBLISHED) for system in (CARTOGRAPHER, 'graph mapping')
        ]
        lama = _peer(LAMA, name, Origin.TEAM)
        row = [
            f'{_NAMES[name]} (`{name}`)',
            f'{known[name]["live_m"]:.3f}',
            f'{known[name]["final_m"]:.3f}',
            *(shown(run.final_m) if run else '' for run in published),
            shown(lama.live_m) if lama else '',
        ]
        rows.append(row)
    table = markdown(_COMPLETE_COLUMNS, rows)
    return [f'## Complete logs\n\n{table}\n\n', _COMPLETE_NOTES]


def _intel_table(reports: Sequence[Numbers]) -> list[str]:
    ours = _by_name(reports).get(INTEL)
    if ours is None:
        return []
    own = [f'{ours[key]:{form}}' for key, form in _INTEL_FORMS.items()]
    rows = [['**thinmap**', *own, 'this page']]
    for run in sorted(slam_run.runs(INTEL), key=_error):
        name = run.system + (f', {run.note}' if run.note else '')
        costs = [f'{cost:g}' if cost is not None else '' for cost in (run.cpu_ms, run.peak_mb)]
        rows.append([name, shown(run.live_m), shown(run.final_m), *costs, run.origin.value])
    table = markdown(_INTEL_COLUMNS, rows)
    return [f'## Intel Research Lab, 5,438 scans\n\n{table}\n\n', _INTEL_NOTES]


def _error(run: slam_run.PeerRun) -> float:
    assert run.live_m is not None
    return run.live_m[0]


def _why(reports: Sequence[Numbers], stamps: Sequence[Sequence[str]]) -> list[str]:
    known = _by_name(reports)
    if not stamps or not {'intel_raw', THINNED} <= set(known):
        return []
    complete = known['intel_raw']['live_m']
    thinned = known[THINNED]['live_m']
    head = _WHY.format(complete=complete, thinned=thinned)
    return [head, _matrix(stamps), '\n', _WHY_END]


def _matrix(stamps: Sequence[Sequence[str]]) -> str:
    """A table: a row for each judgement, a column for each path."""
    values: dict[str, dict[str, str]] = {}
    for what, value in stamps:
        path, _, judgement = what.partition(': ')
        values.setdefault(judgement, {})[path] = value
    paths = list(dict.fromkeys(path for row in values.values() for path in row))
    rows = [[name, *(row.get(path, '') for path in paths)] for name, row in values.items()]
    return markdown(['', *paths], rows).replace('|  |', '| |', 1)


def _stamps(folder: Path) -> list[list[str]]:
    return [row[:2] for row in read_rows(folder / f'{STAMPS}.csv')]


_KEYS = (
    ('thinmap', OURS, True),
    ('run by the team', OTHERS[Origin.TEAM], True),
    ('published', OTHERS[Origin.PUBLISHED], True),
    ('open: final poses', '#000000', False),
)


def _panels(reports: Sequence[Numbers]) -> list[Panel]:
    known = _by_name(reports)
    panels = []
    for log in (INTEL, *COMPLETE):
        if log in known:
            title = f'{_NAMES[log]}, complete' if log in _NAMES else 'Intel, 5,438 scans'
            panels.append(Panel(title, 'mean error (m)', _marks(known[log], log), is_log=True))
    return panels


def _marks(ours: Numbers, log: str) -> list[Mark]:
    marks = [
        Mark('thinmap', ours['live_m']),
        Mark('thinmap', ours['final_m'], is_filled=False),
    ]
    for run in slam_run.runs(log):
        colour = OTHERS[run.origin]
        for metres, is_live in ((run.live_m, True), (run.final_m, False)):
            if metres is not None:
                marks.append(span(run.system, metres, colour, is_live))
    return marks


if __name__ == '__main__':
    page_program(write)
