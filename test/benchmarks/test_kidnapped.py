"""Benchmark of kidnapped robots.

Existing results are not computed again, and the page is made from them.
"""

from pathlib import Path

import pytest

from benchmarks.kidnapped.page import page
from benchmarks.kidnapped.summary import summary
from benchmarks.kidnapped.trials import Record
from benchmarks.rows import Case, read_records, run_pending


def cases(ran: list[str], outcomes: dict[str, str]) -> list[Case]:
    def run(name: str) -> Record:
        ran.append(name)
        return {
            'outcome': outcomes[name],
            'way_m': 2.5,
            'steps': 12,
            'off_m': '',
            'off_deg': '',
            'step_ms': 9.0,
        }

    return [Case(name, lambda name=name: run(name)) for name in outcomes]


def test_a_row_is_resumed_and_shown_on_the_page(tmp_path: Path) -> None:
    ran: list[str] = []
    outcomes = {'kth/a 0': 'right', 'kth/a 1': 'open', 'kth/b 0': 'wrong'}
    path = tmp_path / 'kth.csv'
    run_pending(cases(ran, outcomes)[:2], path)
    run_pending(cases(ran, outcomes), path)
    assert ran == list(outcomes)
    assert [record['outcome'] for record in read_records(path)] == list(outcomes.values())
    rows = {row.what: row for row in summary('kth', read_records(path))}
    assert rows['correct, false, not localized'].value == '1, 1, 1'
    assert rows['false localizations (%)'].good is False
    made = 'Commit 1234567, a processor, 2 cores, Python 3.12.3'
    (tmp_path / 'provenance.txt').write_text(f'{made}\n')
    text = page(tmp_path)
    assert text.startswith('# Global localization: correct, false, not localized\n\n')
    assert f'\n\n{made}\n\n![' in text
    assert '| kth/a | 2 | 1 | 0 | 1 | 2.5 | 2.5 |' in text
    assert '| kth/b | 1 | 0 | 1 | 0 | 2.5 | 2.5 |' in text
    assert '## Dungeons' not in text


@pytest.mark.parametrize(
    ('said', 'sure', 'good'), [('4.2', '', (True, True)), ('', '3.1', (False, False))]
)
def test_robots_in_another_building_are_told_so_and_never_localized(
    said: str, sure: str, good: tuple[bool, bool]
) -> None:
    records = [{'case': 'a <- b', 'said_m': said, 'sure_m': sure, 'last': 'NOT_IN_MAP'}]
    rows = {row.what: row.good for row in summary('foreign', records)}
    assert (rows['reported as not in this map (%)'], rows['false localizations (%)']) == good
