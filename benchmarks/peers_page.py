"""Make docs/results/peers.md: every other program, how it was run, and its figures beside ours.

Usage: python -m benchmarks.peers_page DIR [DOCS]. DIR has the folder slam of `python -m benchmarks
release`. The text is that of peers_page.md.
"""

from collections.abc import Sequence
from pathlib import Path

from benchmarks.charts import OTHERS, OURS, Mark, Panel, page_program, picture, write_page
from benchmarks.rows import markdown, read_records
from benchmarks.scoreboard.played import Numbers
from benchmarks.scoreboard.results_page import made_lines, read_reports
from thinmap_ros.evaluation.parallel_jobs import provenance
from thinmap_ros.evaluation.slam_run import INTEL, PEERS, Origin, PeerRun, runs, shown
from thinmap_ros.files.safe import read_text

_CHART = 'peers'
_COLUMNS = (
    'program',
    'log',
    'live',
    'final',
    'CPU ms per scan',
    'memory (MB)',
    'thinmap, live / final',
    'source',
)
_LAMA = Path(__file__).parent / 'peers'
_LAMA_COLUMNS = (
    'run',
    'scans processed',
    'live (m)',
    'CPU ms per scan',
    'per processed scan',
)
_TEMPLATE = Path(__file__).with_suffix('.md')


def write(folder: Path, docs: Path) -> Path:
    """Write the page of a folder of all results, and its chart. Returns its path."""
    reports = read_reports(folder / 'slam')
    for report in reports:
        report.setdefault('made', provenance(folder / 'slam'))
    logs = {run.log for run in PEERS}
    ours = {r['name']: r for r in reports if r['name'] in logs and 'live_m' in r}
    return write_page(docs / 'results' / f'{_CHART}.md', page(ours), panels(ours), _KEYS)


def page(ours: dict[str, Numbers]) -> str:
    """Text of the page; ours: reports of thinmap by log."""
    caption = 'Intel Research Lab, 5,438 scans: error, time and memory of all programs.'
    figures = {
        origin: [_cells(run, ours.get(run.log)) for run in PEERS if run.origin is origin]
        for origin in Origin
    }
    records = [record.values() for record in read_records(_LAMA / 'peers.csv')]
    return read_text(_TEMPLATE).format(
        chart=picture(_CHART, caption),
        made=made_lines(list(ours.values())),
        figures=markdown(_COLUMNS, figures[Origin.TEAM]),
        published=markdown(_COLUMNS, figures[Origin.PUBLISHED]),
        lama=markdown(_LAMA_COLUMNS, records),
        lama_made=provenance(_LAMA),
        losses='\n'.join(_losses(ours)),
    )


def _losses(ours: dict[str, Numbers]) -> list[str]:
    """A line for each run that has a smaller error than thinmap."""
    lines = []
    for run in PEERS:
        own = ours.get(run.log, {})
        smaller = [
            f'{name} {metres[1]:.3f} against {own[key]:.3f}'
            for name, key, metres in (
                ('live', 'live_m', run.live_m),
                ('final', 'final_m', run.final_m),
            )
            if metres is not None and key in own and metres[1] < own[key]
        ]
        if smaller:
            lines.append(f'- {_title(run)}, `{run.log}`: {", ".join(smaller)}')
    return lines


def _title(run: PeerRun) -> str:
    note = f' ({run.note})' if run.note and run.origin is Origin.TEAM else ''
    return run.system + note


def _cells(run: PeerRun, own: Numbers | None) -> list[str]:
    source = run.note if run.origin is Origin.PUBLISHED else run.origin.value
    return [
        _title(run),
        f'`{run.log}`',
        shown(run.live_m),
        shown(run.final_m),
        f'{run.cpu_ms:g}' if run.cpu_ms is not None else '',
        f'{run.peak_mb:g}' if run.peak_mb is not None else '',
        f'{own["live_m"]:.3f} / {own["final_m"]:.3f}' if own else '',
        source,
    ]


_KEYS = (('thinmap', OURS, True), ('run by the team', OTHERS[Origin.TEAM], True))


def panels(ours: dict[str, Numbers]) -> Sequence[Panel]:
    """Live error, CPU time and memory of the programs that were run on the Intel log."""
    own = ours.get(INTEL)
    if own is None:
        return [Panel('Intel, 5,438 scans', 'mean live error (m)', _errors(), is_log=True)]
    costs = [run for run in runs(INTEL) if run.cpu_ms is not None and run.peak_mb is not None]
    colour = OTHERS[Origin.TEAM]
    times = [Mark(run.system, run.cpu_ms or 0.0, colour) for run in costs]
    memory = [Mark(run.system, run.peak_mb or 0.0, colour) for run in costs]
    return [
        Panel('live error', 'm', [Mark('thinmap', own['live_m']), *_errors()], is_log=True),
        Panel('CPU time per scan', 'ms', [Mark('thinmap', own['ms_mean']), *times], is_log=True),
        Panel('memory, peak', 'MB', [Mark('thinmap', own['mb']), *memory], is_log=True),
    ]


def _errors() -> list[Mark]:
    return [
        Mark(run.system, run.live_m[0], OTHERS[run.origin])
        for run in runs(INTEL)
        if run.live_m is not None
    ]


if __name__ == '__main__':
    page_program(write)
