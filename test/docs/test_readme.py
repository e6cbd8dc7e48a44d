"""README.md: its figures are those of the generated results, and its links lead to files."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / 'README.md').read_text()
RESULTS = ROOT / 'docs' / 'results'


def rows(text: str, first: str) -> list[list[str]]:
    """Cells of all table rows that begin with a cell, without it."""
    return [
        [cell.strip() for cell in line.strip('| ').split('|')][1:]
        for line in text.splitlines()
        if line.startswith(f'| {first} |')
    ]


@pytest.mark.parametrize(
    ('log', 'case'),
    [
        ('Intel Research Lab', 'intel_raw'),
        ('ACES, Austin', 'aces_raw'),
        ('MIT CSAIL', 'csail_raw'),
    ],
)
def test_errors_of_logs(log, case):
    (page,) = rows((RESULTS / 'slam.md').read_text(), case)
    (shown,) = rows(README, log)
    assert shown[:2] == page[1:3]


def test_intel_beside_others():
    (page,) = rows((RESULTS / 'slam.md').read_text(), 'intel')
    assert page[0] == '5438'
    (errors,) = rows(README, 'live / final (m)')
    (times,) = rows(README, 'CPU time per scan, mean (ms)')
    assert errors[0] == ' / '.join(page[1:3])
    assert float(times[0]) == pytest.approx(float(page[10]), abs=0.05)


@pytest.mark.parametrize(
    ('worlds', 'section'),
    [
        ('8 random worlds of 50 x 50 m', 'Dungeons (8)'),
        ('2 real floors of a university', 'KTH floors (2)'),
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
