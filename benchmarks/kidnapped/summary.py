"""What came of many lost robots, in a few lines each."""

from collections import defaultdict
from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.kidnapped.split_log import is_in_map
from thinmap_ros.evaluation.outcome import Row, at_least, at_most

Written = dict[str, str]  # a record as it is in a file
_SCANS = 30
_NOTICED_S = 5.0


def summary(row: str, records: list[Written]) -> Iterator[Row]:
    """Rows of what the cases of a row came to."""
    yield from _SUMMARIES[row](records)


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


def outcomes(
    records: list[Written], right: float, wrong: float, steps: float | None = None
) -> Iterator[Row]:
    """Rows of drives that end where the robot is sure; right, wrong: percent wanted.

    Steps: their median wanted.
    """
    count = len(records)
    counts = {
        word: sum(record['outcome'] == word for record in records)
        for word in ('right', 'wrong', 'open')
    }
    yield Row('drives', f'{count}')
    yield at_least('right, of 100', percent(counts['right'], count), right)
    yield at_most('wrong and sure, of 100', percent(counts['wrong'], count), wrong)
    yield Row('right, wrong, not sure', f'{counts["right"]}, {counts["wrong"]}, {counts["open"]}')
    taken = [float(record['steps']) for record in records]
    if steps is not None:
        yield at_most('steps, median', float(np.median(taken)), steps)
    for what, values in (
        ('steps', taken),
        ('way, m', [float(record['way_m']) for record in records]),
    ):
        shares = ' '.join(f'{value:.3g}' for value in np.percentile(values, [50, 90, 97, 100]))
        yield Row(f'{what}: 50, 90, 97, 100 of 100', shares)
    yield Row(
        'processor time of a step, median',
        f'{np.median([float(r["step_ms"]) for r in records]):.3g} ms',
    )


def _twins(records: list[Written]) -> Iterator[Row]:
    for name, group in by_group(records).items():
        steps, sure, equal = (
            sum(int(record[key]) for record in group) for key in ('steps', 'sure', 'equal')
        )
        yield Row(f'{name}: drives, steps', f'{len(group)}, {steps}')
        yield at_most('sure, of 100 steps', percent(sure, steps), 0.0)
        yield at_least('weights within 0.1, of 100 steps', percent(equal, steps), 95.0)


def _foreign(records: list[Written]) -> Iterator[Row]:
    count = len(records)
    ways = [float(record['said_m']) for record in records if record['said_m']]
    sure = [record['case'] for record in records if record['sure_m']]
    yield Row('maps with robots of other buildings', f'{count}')
    yield at_least('told "not in this map", of 100', percent(len(ways), count), 95.0)
    at_last = sum(record['last'] == 'NOT_IN_MAP' for record in records)
    yield Row('told so at the end, of 100', f'{percent(at_last, count):.3g}')
    yield at_most('sure at some time, of 100', percent(len(sure), count), 0.0)
    if sure:
        yield Row('these', '; '.join(sure))
    shares = ' '.join(f'{value:.3g}' for value in np.percentile(ways or [0.0], [50, 90]))
    yield Row('way until told, m: 50, 90 of 100', shares)


def _kidnapped(records: list[Written]) -> Iterator[Row]:
    count = len(records)
    noticed = [
        float(record['detected_after_s']) for record in records if record['detected_after_s']
    ]
    found = [record for record in records if record['found_after_s']]
    right = sum(record['found_right'] == 'True' for record in found)
    yield Row('kidnapped robots', f'{count}')
    yield at_least(
        'noticed within 5 s, of 100', percent(sum(s <= _NOTICED_S for s in noticed), count), 95.0
    )
    yield at_least('right again, of 100', percent(right, count), 97.0)
    yield at_most('wrong and sure, of 100', percent(len(found) - right, count), 0.5)
    for what, values in (
        ('noticed after, s', noticed),
        ('found after that, s', [float(record['found_after_s']) for record in found]),
        ('and m', [float(record['found_after_m']) for record in found]),
    ):
        shares = ' '.join(f'{value:.3g}' for value in np.percentile(values or [0.0], [50, 90, 100]))
        yield Row(f'{what}: 50, 90, 100 of 100', shares)


def _halves(records: list[Written]) -> Iterator[Row]:
    inside = [record for record in records if is_in_map(record)]
    yield Row('starts, of these in the map', f'{len(records)}, {len(inside)}')
    for what, chosen, wanted in (('all', records, None), ('in the map', inside, 90.0)):
        right = [record for record in chosen if record['outcome'] == 'right']
        soon = percent(sum(int(record['steps']) <= _SCANS for record in right), len(chosen))
        name = f'{what}: right within {_SCANS} scans, of 100'
        yield Row(name, f'{soon:.3g}') if wanted is None else at_least(name, soon, wanted)
        yield Row(
            f'{what}: right within 60 scans, of 100', f'{percent(len(right), len(chosen)):.3g}'
        )
    wrong = sum(record['outcome'] == 'wrong' for record in records)
    yield at_most('wrong and sure, of 100', percent(wrong, len(records)), 1.0)


def _usual(records: list[Written]) -> Iterator[Row]:
    yield from outcomes(records, 97.0, 0.5)


_Summary = Callable[[list[Written]], Iterator[Row]]
_WORLDS = ('kth', 'dungeon', 'lasers', 'fine', 'driven')
_SUMMARIES: dict[str, _Summary] = {
    'paper': lambda records: outcomes(records, 100.0, 0.0),
    'lab': lambda records: outcomes(records, 99.0, 0.0, 6.0),
    'voronoi': lambda records: outcomes(records, 99.0, 0.0, 6.0),
    'twins': _twins,
    'foreign': _foreign,
    'foreign_log': _foreign,
    'kidnapped': _kidnapped,
    'halves': _halves,
    **dict.fromkeys(_WORLDS, _usual),
}
