"""Paper 1, Fig. 6 to 9: local maps at twelve stops merged into one topological map."""

from itertools import groupby

import numpy as np
from scipy.spatial import cKDTree

from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid, WindowConfig
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import TopologyBuilder, build
from thinmap_ros.evaluation.outcome import Comparison, Outcome, Rows, Table
from thinmap_ros.experiments.drives import Source, grid_of
from thinmap_ros.sim.drives import DriveSample
from thinmap_ros.view.plots import GraphLayer, MapLayer, Panel, Plot, RobotMarkers

# The stops near (3 m, 8 m) and (2.3 m, 3 m)
_FIRST_STOPS = (2, 1)
_SAME_M = 0.5  # largest distance of nodes of two maps that agree


def run(source: Source) -> Outcome:
    """Merge stop by stop; the global grid is only used to judge the result."""
    by_place = groupby(source.samples('lab_stops'), lambda sample: tuple(sample.T_world_base[:2]))
    stops = [list(samples) for _, samples in by_place]
    order = [*_FIRST_STOPS, *(k for k in range(len(stops)) if k not in _FIRST_STOPS)]
    builder = TopologyBuilder(TopologyConfig())
    grid = OccupancyGrid(PAPER_GRID)
    growth = []
    panels = []
    states = []
    for number, stop in enumerate(order, 1):
        _visit(stops[stop], grid, builder)
        states.append(builder.map.copy())
        sizes = (len(builder.map.nodes), len(builder.map.edges))
        growth.append([number, *stops[stop][0].T_world_base[:2], *sizes])
        if number == 2:
            panels.append(_panel(grid, states[-1], 'merged from both'))
    locals_ = [
        _local_map(stops[stop], f'local map {number}')
        for number, stop in enumerate(_FIRST_STOPS, 1)
    ]
    whole = grid_of(sample for stop in stops for sample in stop)
    batch = build(whole.known_area(), _start(stops[0]), TopologyConfig())
    share = _agreement(states[-1], batch)
    back = _agreement(batch, states[-1])
    gone = _redundant(states[1], states[-1])
    return Outcome(
        'Merging of local topological maps',
        'Topological map paper, sections 2.2 and 4.1, Fig. 6 to 9',
        'The robot stands at twelve positions of the laboratory in turn, and scans in two '
        'directions at each. The local window of the grid around the robot is thinned and merged '
        'into the global map. The reference is the batch map, made from the grid of all scans.',
        [
            Table('growth', ['stop', 'x_m', 'y_m', 'nodes', 'edges'], growth),
            Table('nodes', ['id', 'kind', 'x_m', 'y_m', 'clearance_m'], _rows(states[-1])),
        ],
        _plots([*locals_, *panels], whole, _panel(grid, states[-1], '')),
        [
            Comparison(
                'stops merged into one map', '10 to 15', str(len(stops)), 10 <= len(stops) <= 15
            ),
            Comparison(
                'one connected map',
                'yes',
                f'{len(states[-1].components())} part',
                len(states[-1].components()) == 1,
            ),
            Comparison(
                'redundant nodes at the edge of the window, deleted by the end',
                'deleted after update',
                f'{gone} of the {len(states[1].nodes)} nodes of the first two stops',
            ),
            Comparison(
                f'nodes within {_SAME_M} m of a node of the batch map, and vice versa',
                '',
                f'{share:.0%}, {back:.0%}',
            ),
        ],
    )


def _plots(early: list[Panel], whole: OccupancyGrid, final: Panel) -> list[Plot]:
    return [
        Plot(
            'fig7_8',
            'Paper 1, Fig. 7 and 8: the local maps of two stops, and the map merged from them.',
            early,
            columns=3,
            panel_inches=(5.0, 4.6),
        ),
        Plot(
            'fig6_9',
            'Paper 1, Fig. 6 and 9: the global grid map (above; only for better understanding) '
            'and the final global topological map.',
            [Panel([MapLayer(whole.known_area())]), final],
            panel_inches=(9.0, 4.6),
        ),
    ]


def _visit(samples: list[DriveSample], grid: OccupancyGrid, builder: TopologyBuilder) -> None:
    window_m = WindowConfig().local_map_size_m
    for sample in samples:
        grid.add_scan(sample.scan, sample.T_world_base)
        x, y, _ = sample.T_world_base
        builder.update(grid.window(float(x), float(y), window_m), sample.T_world_base)


def _local_map(samples: list[DriveSample], title: str) -> Panel:
    grid = grid_of(samples)
    graph = build(grid.known_area(), _start(samples), TopologyConfig())
    x, y = _start(samples)
    return _panel(grid, graph, f'{title}, sensor at ({x:g} m, {y:g} m)', samples[0].T_world_base)


def _panel(
    grid: OccupancyGrid, graph: TopologicalMap, title: str, robot: Array | None = None
) -> Panel:
    robots = [] if robot is None else [RobotMarkers(robot[None], 'sensor')]
    return Panel([MapLayer(grid.known_area()), GraphLayer(graph), *robots], title)


def _start(samples: list[DriveSample]) -> tuple[float, float]:
    return float(samples[0].T_world_base[0]), float(samples[0].T_world_base[1])


def _agreement(one: TopologicalMap, other: TopologicalMap) -> float:
    """Share of the nodes of one map that have a node of the other one near."""
    first, second = (
        np.array([node.position for node in graph.nodes.values()]) for graph in (one, other)
    )
    return float(np.mean(cKDTree(second).query(first)[0] <= _SAME_M))


def _redundant(early: TopologicalMap, final: TopologicalMap) -> int:
    """Nodes of an early map where the final one has none."""
    return round(len(early.nodes) * (1.0 - _agreement(early, final)))


def _rows(graph: TopologicalMap) -> Rows:
    return [
        [n.id, NodeKind(n.kind).name.lower(), n.x, n.y, n.clearance_m] for n in graph.nodes.values()
    ]
