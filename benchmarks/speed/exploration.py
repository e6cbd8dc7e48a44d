"""Explorations in the simulator: time of a decision, speed against real time, and coverage."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.rows import Row, at_least, at_most
from benchmarks.worlds import Floor, floors
from thinmap_ros.closed_loop import Options
from thinmap_ros.evaluation.exploration_run import explore

_LARGEST = 'kth/50037764_PLAN1'
_DUNGEON = 'dungeon/'
_DUNGEON_QUICK = 'dungeon/d114'
_FAST = Options(speed_m_s=0.5)
_PART_S = 3000.0
_PART_QUICK_S = 200.0


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows of whole explorations of dungeons, and of times for decisions on the largest floor."""
    yield from _dungeons(floors(worlds, _DUNGEON_QUICK if quick else _DUNGEON))
    yield from _decisions(floors(worlds, _LARGEST)[0], _PART_QUICK_S if quick else _PART_S)


def _dungeons(chosen: list[Floor]) -> Iterator[Row]:
    # Compile, fill caches.
    explore(chosen[0].world, chosen[0].starts[0], replace(_FAST, time_limit_s=30.0))
    reports = []
    speeds = []
    for floor in chosen:
        began = time.process_time()
        _, report = explore(floor.world, floor.starts[0], _FAST)
        speeds.append(report['time'] / (time.process_time() - began))
        reports.append(report)
    yield Row('dungeons explored', f'{len(reports)}')
    yield at_least(
        '  runs that stop by themselves, share',
        float(np.mean([report['finished'] for report in reports])),
        1.0,
    )
    yield at_least('  least coverage', min(report['coverage'] for report in reports), 0.99)
    yield at_most('  collisions', sum(report['collisions'] for report in reports), 0)
    yield Row('  distance, mean', f'{np.mean([report["distance"] for report in reports]):.1f} m')
    yield at_least('  times real time (CPU time), median', float(np.median(speeds)), 100.0)


def _decisions(floor: Floor, limit_s: float) -> Iterator[Row]:
    loop, report = explore(floor.world, floor.starts[0], replace(_FAST, time_limit_s=limit_s))
    yield Row(f'decisions on {floor.name}', f'{len(loop.log.decision_s)}')
    yield at_most('  CPU time of a decision, median', report['decision_ms']['median'], 20.0, 'ms')
    yield at_most('  longest decision', report['decision_ms']['max'], 200.0, 'ms')
