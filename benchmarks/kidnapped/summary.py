"""Summaries of many global localizations, in a few rows each."""

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.kidnapped.trials import is_in_map
from benchmarks.rows import Row, Written, at_least, at_most, read_cases

_SCANS = 30
_NOTICED_S = 5.0


@dataclass(frozen=True)
class Section:
    """A section of the page, with the drives of a row: a line of sections.csv.

    correct, wrong: targets, percent; steps: of their median, 0 for none; is_divided: by worlds.
    """

    name: str
    title: str
    correct: float = 0.0
    wrong: float = 0.0
    steps: float = 0.0
    is_divided: bool = False


_FILE = Path(__file__).with_name('sections.csv')
SECTIONS = {each.name: each for each in read_cases(_FILE, Section)}


def summary(row: str, records: list[Written]) -> Iterator[Row]:
    """Rows that summarize the cases of a row."""
    yield from _SPECIAL[row](records) if row in _SPECIAL else _outcomes(records, SECTIONS[row])


def by_group(records: list[Written]) -> dict[str, list[Written]]:
    """Records by world or laser.

    What comes before the colon or, without one, before the number in a case's name.
    """
    groups: dict[str, list[Written]] = defaultdict(list)
    for record in records:
        name, colon, _ = record['case'].partition(':')
        groups[name if colon else name.rpartition(' ')[0]].append(record)
    return dict(sorted(groups.items()))


def percent(some: int, of: int) -> float:
    """Share in percent; 0 of nothing."""
    return 100.0 * some / max(of, 1)


def _outcomes(records: list[Written], section: Section) -> Iterator[Row]:
    """Rows of drives that end with the localization."""
    count = len(records)
    counts = {
        word: sum(record['outcome'] == word for record in records)
        for word in ('right', 'wrong', 'open')
    }
    yield Row('drives', f'{count}')
    yield at_least('correct localizations (%)', percent(counts['right'], count), section.correct)
    yield at_most('false localizations (%)', percent(counts['wrong'], count), section.wrong)
    yield Row(
        'correct, false, not localized', f'{counts["right"]}, {counts["wrong"]}, {counts["open"]}'
    )
    taken = [float(record['steps']) for record in records]
    if section.steps:
        yield at_most('steps, median', float(np.median(taken)), section.steps)
    for what, values in (
        ('steps', taken),
        ('distance (m)', [float(record['way_m']) for record in records]),
    ):
        shares = ' '.join(f'{value:.3g}' for value in np.percentile(values, [50, 90, 97, 100]))
        yield Row(f'{what}: percentiles 50, 90, 97, 100', shares)
    yield Row(
        'CPU time of a step, median',
        f'{np.median([float(r["step_ms"]) for r in records]):.3g} ms',
    )


def _twins(records: list[Written]) -> Iterator[Row]:
    for name, group in by_group(records).items():
        steps, sure, equal = (
            sum(int(record[key]) for record in group) for key in ('steps', 'sure', 'equal')
        )
        yield Row(f'{name}: drives, steps', f'{len(group)}, {steps}')
        yield at_most('localized (% of steps)', percent(sure, steps), 0.0)
        yield at_least('weights equal within 0.1 (% of steps)', percent(equal, steps), 95.0)


def _foreign(records: list[Written]) -> Iterator[Row]:
    count = len(records)
    ways = [float(record['said_m']) for record in records if record['said_m']]
    sure = [record['case'] for record in records if record['sure_m']]
    yield Row('maps with a robot from another building', f'{count}')
    yield at_least('reported as not in this map (%)', percent(len(ways), count), 95.0)
    at_last = sum(record['last'] == 'NOT_IN_MAP' for record in records)
    yield Row('reported at the end (%)', f'{percent(at_last, count):.3g}')
    yield at_most('false localizations (%)', percent(len(sure), count), 0.0)
    if sure:
        yield Row('cases with a false localization', '; '.join(sure))
    shares = ' '.join(f'{value:.3g}' for value in np.percentile(ways or [0.0], [50, 90]))
    yield Row('distance until the report (m): percentiles 50, 90', shares)


def _kidnapped(records: list[Written]) -> Iterator[Row]:
    count = len(records)
    noticed = [
        float(record['detected_after_s']) for record in records if record['detected_after_s']
    ]
    found = [record for record in records if record['found_after_s']]
    right = sum(record['found_right'] == 'True' for record in found)
    yield Row('kidnapped robots', f'{count}')
    yield at_least(
        'kidnapping detected within 5 s (%)',
        percent(sum(s <= _NOTICED_S for s in noticed), count),
        95.0,
    )
    yield at_least('correct relocalizations (%)', percent(right, count), 97.0)
    yield at_most('false localizations (%)', percent(len(found) - right, count), 0.5)
    for what, values in (
        ('time until detection (s)', noticed),
        (
            'time from detection to relocalization (s)',
            [float(record['found_after_s']) for record in found],
        ),
        ('distance in this time (m)', [float(record['found_after_m']) for record in found]),
    ):
        shares = ' '.join(f'{value:.3g}' for value in np.percentile(values or [0.0], [50, 90, 100]))
        yield Row(f'{what}: percentiles 50, 90, 100', shares)


def _halves(records: list[Written]) -> Iterator[Row]:
    inside = [record for record in records if is_in_map(record)]
    yield Row('starts, starts in the map', f'{len(records)}, {len(inside)}')
    for what, chosen, wanted in (('all', records, None), ('in the map', inside, 90.0)):
        right = [record for record in chosen if record['outcome'] == 'right']
        soon = percent(sum(int(record['steps']) <= _SCANS for record in right), len(chosen))
        name = f'{what}: correct within {_SCANS} scans (%)'
        yield Row(name, f'{soon:.3g}') if wanted is None else at_least(name, soon, wanted)
        yield Row(f'{what}: correct within 60 scans (%)', f'{percent(len(right), len(chosen)):.3g}')
    wrong = sum(record['outcome'] == 'wrong' for record in records)
    yield at_most('false localizations (%)', percent(wrong, len(records)), 1.0)


_SPECIAL: dict[str, Callable[[list[Written]], Iterator[Row]]] = {
    'twins': _twins,
    'foreign': _foreign,
    'foreign_log': _foreign,
    'kidnapped': _kidnapped,
    'halves': _halves,
}
