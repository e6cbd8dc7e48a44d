"""Global localization: step time, memory, some drives; `benchmarks.kidnapped` has all."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from benchmarks.kidnapped.cases import ROWS, Setting
from benchmarks.kidnapped.summary import summary
from benchmarks.kidnapped.trials import shifted_map
from benchmarks.rows import Row, at_most
from benchmarks.time_and_memory import median_seconds
from benchmarks.worlds import floor
from thinmap_ros.core.places.likelihood import Judge
from thinmap_ros.core.places.place_database import (
    GlobalLocalizationConfig,
    NodeModel,
    Places,
    observe,
    random_pose,
)
from thinmap_ros.core.topology.graph import Node, NodeKind, TopologicalMap
from thinmap_ros.sim.drives import random_drive

_QUICK = {'paper': 5, 'lab': 20, 'voronoi': 20, 'twins': 2, 'foreign': 4, 'dungeon': 10}


def _step_times(folder: Path, quick: bool) -> Iterator[Row]:
    """5,000 samples against 10 observed nodes and a scan's beams, in maps of few and many nodes."""
    there = floor('kth/50052749', folder)
    patch = shifted_map(there.world).patch
    drive_sample = next(random_drive(there.world, there.starts[0], 0))
    rng = np.random.default_rng(0)
    for count, limit in ((30, 2.0), (120, 3.0), (2000, 5.0)):
        config = GlobalLocalizationConfig()
        free = patch.frame.centres_of(rng.permutation(np.argwhere(patch.free))[:count])
        nodes = [Node(k, NodeKind.BRANCH, x, y, 1.0) for k, (x, y) in enumerate(free.tolist(), 1)]
        places = Places.of(patch, TopologicalMap(nodes), config)
        judge = Judge(places, config, NodeModel(np.full(3, 0.5), np.full(3, 0.4), np.full(3, 20.0)))
        seen = replace(
            observe(drive_sample.scan, patch.frame.resolution, config),
            nodes=rng.normal(0.0, 2.0, (10, 2)),
            node_kinds=np.ones(10, dtype=np.int64),
        )
        samples = np.array([random_pose(places, rng) for _ in range(config.samples)])
        taken = 1e3 * median_seconds(
            partial(judge.log_likelihoods, samples, seen), 20 if quick else 200
        )
        yield at_most(f'step with 10 observed nodes, {count} in the map', taken, limit, 'ms')
        yield Row('  memory of the map', f'{places.memory_bytes() / 1e6:.3g} MB', 'at most 50 MB')


def run(folder: Path, quick: bool) -> Iterator[Row]:
    """Step times, and the first drives of some sections; quick: fewer."""
    yield from _step_times(folder, quick)
    for row, count in _QUICK.items():
        cases = islice(ROWS[row](Setting(folder, Path())), count if quick else 4 * count)
        records = [{'case': case.name, **case.run()} for case in cases]
        written = [{key: str(value) for key, value in record.items()} for record in records]
        yield Row(f'drives: {row}', '')
        yield from (replace(line, what=f'  {line.what}') for line in summary(row, written))
