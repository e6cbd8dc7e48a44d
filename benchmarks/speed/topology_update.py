"""A drive through worlds: time of a cycle, global against batch graph of a grid, ids that stay."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.drive import Drive, final_map, tour
from benchmarks.graphs.graph_metrics import agreement, drivable_share, loop_count
from benchmarks.rows import Row, at_least, at_most
from benchmarks.worlds import floors

_QUICK = ('dungeon/d114',)
_WORLDS = ('dungeon/d114', 'dungeon/d2555', 'kth/50052751', 'kth/50052748')
_WARM_UP = 20
_RUN = 6000  # scans in 20 min


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows for each world, as they come."""
    for name in _QUICK if quick else _WORLDS:
        floor = floors(worlds, name)[0]
        poses = tour(floor.world, floor.starts[0], 0.25, 8 if quick else 40, 0)
        drive = Drive(floor.world)
        drive.run(poses)
        milliseconds = 1e3 * np.array(drive.ledger.seconds[_WARM_UP:])[:_RUN]
        tenth = len(milliseconds) // 10
        graph = drive.builder.map
        batch = final_map(drive, floor.starts[0])
        there, back = agreement(graph, batch, 0.5)
        yield from [
            Row(name, f'{len(poses)} scans', '', None),
            at_most('  update, median', float(np.median(milliseconds)), 2.0, 'ms'),
            at_most('  update, longest', float(milliseconds.max()), 10.0, 'ms'),
            at_most(
                '  update, last tenth / first tenth',
                float(np.median(milliseconds[-tenth:]) / np.median(milliseconds[:tenth])),
                1.2,
            ),
            at_least('  share of nodes within 0.5 m of a node of the batch map', there, 0.95),
            at_least('  share of nodes of the batch map within 0.5 m of a node', back, 0.95),
            Row(
                '  loops',
                f'{loop_count(graph)}',
                f'{loop_count(batch)}',
                loop_count(graph) == loop_count(batch),
            ),
            _components(len(graph.components()), len(batch.components())),
            at_least(
                '  share of nodes in the window that keep their ids',
                drive.ledger.kept / max(drive.ledger.asked, 1),
                0.99,
            ),
            at_least(
                '  share of drivable edges',
                drivable_share(drive.grid.known_area(), graph, 0.25),
                1.0,
            ),
        ]


def _components(found: int, wanted: int) -> Row:
    return Row('  components', f'{found}', f'{wanted}', found == wanted)
