"""Paper 1, Fig. 3, 4: local topological map of a scan; thinning against the Voronoi diagram."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from thinmap_ros.baselines.voronoi import build_voronoi
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.evaluation.outcome import Comparison, Outcome, Rows, Table
from thinmap_ros.experiments.drives import Source, grid_of, patch_at_rest
from thinmap_ros.sim.drives import DriveSample
from thinmap_ros.view.plots import Curve, GraphLayer, MapLayer, Panel, Plot, RobotMarkers, xy

_WORLDS = ('room_10x10', 'office', 'floor_40x10')


@dataclass(frozen=True)
class _Setup:
    """Pruning distances, the scans of Fig. 3, and what the paper reports.

    prune_m: all that are compared; reported_m: those of the summary; shown_m: that of Fig. 4, which
    prunes all branches into corners. scans: of the third stop, (3 m, 8.3 m, 0 deg), as in the
    paper's Fig. 3 and 7(a). paper_more_nodes: nodes of thinning beyond those of Voronoi.
    """

    prune_m: tuple[float, ...]
    reported_m: tuple[float, ...]
    shown_m: float
    scans: slice
    paper_more_nodes: int


_SETUP = _Setup(
    prune_m=(0.2, 0.4, 0.6, 0.8, 1.0, 1.5, 2.0, 3.0),
    reported_m=(0.6, 1.5, 3.0),
    shown_m=3.0,
    scans=slice(16, 20),
    paper_more_nodes=4,
)


def run(source: Source) -> Outcome:
    """Compare by pruning distance: nodes and edges (always the same), and times."""
    samples = list(source.samples('lab_stops'))
    maps = {'lab': grid_of(samples).known_area()}
    maps |= {name: patch_at_rest(name) for name in _WORLDS[: 1 if source.quick else None]}
    counts: Rows = []
    times: Rows = []
    for name, patch in maps.items():
        for prune_m in _SETUP.prune_m:
            (thin_s, thinned), (voronoi_s, voronoi) = map(_timed, _methods(patch, prune_m))
            sizes = [len(thinned.nodes), len(voronoi.nodes), len(thinned.edges), len(voronoi.edges)]
            counts.append([name, prune_m, *sizes])
            times.append([name, prune_m, 1e3 * thin_s, 1e3 * voronoi_s])
    more = {prune_m: n - v for name, prune_m, n, v, *_ in counts if name == 'lab'}
    faster = float(np.median([voronoi_ms / thin_ms for _, _, thin_ms, voronoi_ms in times]))
    columns = [
        'map',
        'prune_m',
        'nodes_thinning',
        'nodes_voronoi',
        'edges_thinning',
        'edges_voronoi',
    ]
    return Outcome(
        'Thinning against the Voronoi diagram',
        'Topological map paper, section 2.1, Fig. 3 and 4',
        'Maps: the laboratory, merged from scans at its twelve stops, and simulated worlds without '
        'noise, cells of 0.1 m. The Voronoi diagram is that of all cells at the edge of the free '
        'space. Both methods have the same free space, pruning length, merging of branch nodes and '
        'corner nodes. Whole floors: section `voronoi` of the page Speed.',
        [
            Table('nodes', columns, counts),
            Table('times', ['map', 'prune_m', 'thinning_ms', 'voronoi_ms'], times, timed=True),
        ],
        [_local_map(samples[_SETUP.scans]), _both(maps['lab']), _curves(counts, times)],
        [
            Comparison(
                'CPU time',
                'thinning needs less',
                f'{faster:.1f} times less for the graph (median)',
                faster > 1.0,
                True,
            ),
            Comparison(
                'additional nodes of thinning, laboratory',
                f'{_SETUP.paper_more_nodes} in its example',
                ', '.join(
                    f'{more[prune_m]:+d} with branches up to {prune_m:g} m pruned'
                    for prune_m in _SETUP.reported_m
                ),
                max(more.values()) >= _SETUP.paper_more_nodes,
                remark='A Voronoi diagram has a branch into each corner. With these branches '
                'pruned, both methods have about as many nodes. Additional nodes come from the '
                'rules for nodes, not from thinning.',
            ),
        ],
    )


def _methods(patch: GridPatch, prune_m: float) -> Iterator[Callable[[], TopologicalMap]]:
    config = TopologyConfig(min_branch_length_m=prune_m, min_branch_ratio=0.0)
    yield lambda: build(patch, None, config)
    yield lambda: build_voronoi(patch, config)


def _timed(work: Callable[[], TopologicalMap]) -> tuple[float, TopologicalMap]:
    """Shortest of three CPU times, s, and the result."""
    taken = []
    for _ in range(3):
        began = time.process_time()
        result = work()
        taken.append(time.process_time() - began)
    return min(taken), result


def _local_map(samples: list[DriveSample]) -> Plot:
    sample = samples[0]
    patch = grid_of(samples).known_area()
    points = sample.scan.points_base()
    xy = (float(sample.T_world_base[0]), float(sample.T_world_base[1]))
    graph = build(patch, xy, TopologyConfig())
    robot = np.array([sample.T_world_base])
    return Plot(
        'fig3',
        'Paper 1, Fig. 3: (a) range data of one scan, laser at the origin; '
        '(b) the binary map of four such scans, with arcs and nodes by thinning.',
        [
            Panel(
                [Curve(points, 'range data', 0, '', '.'), RobotMarkers(np.zeros((1, 3)), 'laser')],
                '(a)',
            ),
            Panel([MapLayer(patch), GraphLayer(graph), RobotMarkers(robot)], '(b)'),
        ],
        columns=2,
        panel_inches=(5.0, 4.2),
    )


def _both(patch: GridPatch) -> Plot:
    thinned, voronoi = (work() for work in _methods(patch, _SETUP.shown_m))
    return Plot(
        'fig4',
        'Paper 1, Fig. 4: the laboratory by Voronoi diagram (left) and by thinning (right), '
        f'branches up to {_SETUP.shown_m} m pruned in both.',
        [
            Panel([MapLayer(patch), GraphLayer(voronoi)], f'Voronoi: {len(voronoi.nodes)} nodes'),
            Panel([MapLayer(patch), GraphLayer(thinned)], f'thinning: {len(thinned.nodes)} nodes'),
        ],
        columns=2,
        panel_inches=(7.0, 4.0),
    )


def _curves(counts: Rows, times: Rows) -> Plot:
    def of_lab(rows: Rows, column: int) -> np.ndarray:
        return np.array([float(str(row[column])) for row in rows if row[0] == 'lab'])

    x = of_lab(counts, 1)
    panels = []
    for rows, label, log in ((counts, 'nodes', False), (times, 'time (ms)', True)):
        layers = [
            Curve(xy(x, of_lab(rows, 2)), 'thinning', 0, marker='o'),
            Curve(xy(x, of_lab(rows, 3)), 'Voronoi', 1, '--', marker='s'),
        ]
        panels.append(Panel(layers, '', 'pruning length (m)', label, plan=False, log_y=log))
    return Plot(
        'fig4_by_pruning',
        'Paper 1, to Fig. 4: number of nodes and CPU time against the pruning length; '
        'map of the laboratory.',
        panels,
        columns=2,
        panel_inches=(4.5, 3.4),
    )
