"""README.md: its figures are those of the generated results, and its links lead to files."""

import re
from pathlib import Path

import pytest

from thinmap_ros.evaluation.slam_run import CARTOGRAPHER, LAMA, runs, shown

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / 'README.md').read_text()
RESULTS = ROOT / 'docs' / 'results'


def rows(text: str, first: str) -> list[list[str]]:
    """Cells of all table rows that begin with a cell, without it."""
    return [
        [cell.strip() for cell in line.strip('|').split('|')][1:]
        for line in text.splitlines()
        if line.startswith(f'| {first} |')
    ]


LOGS = {
    'Intel Research Lab, complete': 'intel_raw',
    'ACES, Austin, complete': 'aces_raw',
    'MIT CSAIL, complete': 'csail_raw',
    'Intel, 5,438 scans': 'intel',
}
# Columns after that of thinmap.
PROGRAMS = (LAMA, CARTOGRAPHER, 'graph mapping', 'slam_toolbox', 'Karto', 'GMapping')


def recorded(system: str, log: str) -> str:
    """Cell of another program on a log: live / final, one of both, or empty."""
    found = [run for run in runs(log) if run.system == system]
    if not found:
        return ''
    live = shown(found[0].live_m)
    final = shown(found[0].final_m)
    return ' / '.join((live or '-', final)) if final else live


@pytest.mark.parametrize(('log', 'case'), LOGS.items())
def test_errors_of_logs(log, case):
    (page,) = rows((RESULTS / 'slam.md').read_text(), case)
    (row,) = rows(README, log)
    assert row[0] == ' / '.join(page[1:3])
    assert [re.sub(r' \[\d\]', '', cell) for cell in row[1:]] == [
        recorded(program, case) for program in PROGRAMS
    ]


def test_times_beside_others():
    (page,) = rows((RESULTS / 'slam.md').read_text(), 'intel')
    assert page[0] == '5438'
    (times,) = rows(README, 'CPU time of poses per scan, same log (ms)')
    assert float(times[0]) == pytest.approx(float(page[10]), abs=0.05)
    known = {run.system: run.cpu_ms for run in runs('intel') if run.cpu_ms is not None}
    for program, cell in zip(PROGRAMS, times[1:], strict=True):
        assert (float(cell.split()[0]) if cell else None) == known.get(program)


@pytest.mark.parametrize(
    ('worlds', 'section'),
    [
        ('8 random worlds of 50 x 50 m', 'Random worlds of 50 x 50 m (8)'),
        ('2 real floors of a university', 'Real floors of a university (2)'),
    ],
)
def test_distances_of_explorations(worlds, section):
    page = (RESULTS / 'exploration.md').read_text().split(f'## {section}')[1].split('\n## ')[0]
    distances = []
    for strategy in ('position_probability', 'nearest_frontier', 'explore_lite'):
        row = rows(page, strategy)[0]
        assert (row[0], row[3]) == (row[1], '0')  # all stopped by themselves, without collision
        distances.append(f'{float(row[4].split()[0]):.0f}')
    (shown,) = rows(README, worlds)
    assert shown == distances


def test_links_lead_to_files_and_the_page_is_short():
    links = re.findall(r'\]\(([^)#]+)', README)
    assert [link for link in links if not (ROOT / link).exists()] == []
    assert len(README.splitlines()) <= 90
