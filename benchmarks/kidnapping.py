"""Robots carried off while they explore: how soon that is noticed, and how soon they know again where they are."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.table import Row, at_least, at_most
from benchmarks.worlds import floors
from thinmap_ros.tools.explore_world import Options, explore

_AT_S, _LIMIT_S = 150.0, 300.0


def run(folder: Path, quick: bool) -> Iterator[Row]:
    """Explorations with SLAM of all worlds, at 0.5 m/s; after 150 s the robot is somewhere else on its map."""
    reports = []
    for number, floor in enumerate(floors(folder)[:: 6 if quick else 1]):
        options = Options(
            seed=number, speed_m_s=0.5, localization='slam', time_limit_s=_LIMIT_S, kidnap_at_s=_AT_S
        )
        reports.append(explore(floor.world, floor.starts[0], options)[1])
    count = len(reports)
    noticed = [r['detected_after_s'] for r in reports if r['detected_after_s'] is not None]
    found = [r for r in reports if r['found_after_s'] is not None]
    yield Row('robots carried off', f'{count}')
    yield at_least('noticed within 5 s', 100.0 * sum(s <= 5.0 for s in noticed) / count, 95.0, '%')
    yield at_least('right again within 40 m', 100.0 * sum(r['found_right'] for r in found) / count, 97.0, '%')
    yield at_most('wrong and sure', 100.0 * sum(not r['found_right'] for r in found) / count, 0.5, '%')
    for what, values in (
        ('noticed after, s', noticed), ('found after that, s', [r['found_after_s'] for r in found]),
        ('and m', [r['found_after_m'] for r in found]),
    ):
        yield Row(f'  {what}: 50, 90, 100 of 100', ' '.join(f'{v:.3g}' for v in np.percentile(values, [50, 90, 100])))
