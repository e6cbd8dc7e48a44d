"""Paper 2, Fig. 10: an exploration, with the probabilities of the end nodes at six moments."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.closed_loop.robot import SCANS_PER_GRAPH
from thinmap_ros.core.exploration.paper import PaperExplorer
from thinmap_ros.core.exploration.strategy import FIRST_FRONTIER_ID, Decision
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array, path_length_m
from thinmap_ros.core.stage import Estimate
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.evaluation.exploration_metrics import EndNodeCensus
from thinmap_ros.evaluation.outcome import Comparison, Outcome, Rows, Table
from thinmap_ros.experiments.drives import Source, world_of
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.sim.coverage import robot_observable_cells
from thinmap_ros.sim.drives import DriveSample
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.view.plots import (
    Curve,
    GraphLayer,
    Layer,
    MapLayer,
    Panel,
    Plot,
    RobotMarkers,
    TextLabels,
)


@dataclass(frozen=True)
class _Setup:
    """Pictures, and what counts as success.

    shown: moments of the pictures, as shares of the time. limits: of a picture, x, x, y, y, m.
    paper_s: time of the paper for the room. entire: coverage of an entire environment.
    """

    shown: tuple[float, ...]
    limits: tuple[float, float, float, float]
    paper_s: float
    entire: float


_SETUP = _Setup(
    shown=(0.05, 0.2, 0.4, 0.6, 0.8, 1.0),
    limits=(-0.3, 10.6, -0.3, 10.3),
    paper_s=120.0,
    entire=0.99,
)


@dataclass(frozen=True, eq=False)
class _Moment:
    """State of map and graph at a scan."""

    seconds: float
    T_map_base: Array
    patch: GridPatch
    graph: TopologicalMap
    decision: Decision


def run(source: Source) -> Outcome:
    """Replay the decisions of the drive from the same scans, and show the map at six moments."""
    world = world_of('room_10x10')
    moments, census = _replay_exploration(list(source.samples('room_10x10')))
    goal = robot_observable_cells(
        world, world.start, PRESETS['2dx'], LaserScannerConfig().range_max_m
    )
    coverage = [(m.seconds, goal.coverage(m.patch)) for m in moments]
    last = moments[-1]
    poses = np.array([moment.T_map_base for moment in moments])
    way_m = path_length_m(poses)
    shown = [moments[round(share * (len(moments) - 1))] for share in _SETUP.shown]
    unvisited = census.seen - census.visited
    return Outcome(
        'Exploration by position probability',
        'Exploration paper, section 4, Fig. 10',
        'The room of 10 x 10 m, cells of 10 cm, 181 beams over 180 degrees, at most 0.2 m/s, '
        'with exact poses, by the strategy `paper`: position probability as the paper prints it. '
        'The labels are the id and the position probability of each end node.',
        [
            Table('end_nodes', _COLUMNS, _rows(moments)),
            Table('coverage', ['time_s', 'coverage'], coverage),
        ],
        [
            Plot(
                'fig10',
                'Paper 2, Fig. 10: the exploration at six moments; '
                'id and position probability of each end node, and the path.',
                [_panel(m, poses[: moments.index(m) + 1]) for m in shown],
                columns=3,
                panel_inches=(4.6, 4.6),
            )
        ],
        [
            Comparison(
                'exploration time',
                f'under {_SETUP.paper_s:.0f} s',
                f'{last.seconds:.0f} s, {way_m:.1f} m',
                last.seconds < _SETUP.paper_s,
            ),
            Comparison(
                'coverage',
                'the entire environment',
                f'{coverage[-1][1]:.1%}',
                coverage[-1][1] >= _SETUP.entire,
            ),
            Comparison(
                'end nodes that are never visited',
                'some',
                f'{unvisited} of {census.seen}',
                unvisited > 0,
            ),
        ],
    )


_COLUMNS = [
    'time_s',
    'end_node',
    'x_m',
    'y_m',
    'probability',
    'distance_index',
    'angle_index',
    'is_target',
]


def _replay_exploration(samples: list[DriveSample]) -> tuple[list[_Moment], EndNodeCensus]:
    """State of map and graph once a second, and at the end."""

    def here(scan: object, T_odom_base: Array) -> Estimate:
        return Estimate(truth, np.zeros((3, 3)), np.zeros(3))

    pipeline = Pipeline(PipelineConfig(grid=PAPER_GRID, scans_per_graph=SCANS_PER_GRAPH), here)
    explorer = PaperExplorer()
    census = EndNodeCensus()
    moments = []
    for k, sample in enumerate(samples):
        truth = sample.T_world_base
        pipeline.step(sample.scan, sample.T_odom_base)
        patch = pipeline.grid.known_area()
        graph = pipeline.topology.map
        decision = explorer.step(graph, patch, sample.scan, truth)
        census.add([(n.node_id, n.x, n.y) for n in decision.end_nodes], truth)
        if k % 5 == 0 or k == len(samples) - 1:
            moments.append(
                _Moment(sample.scan.stamp_ns / 1e9, truth, patch, graph.copy(), decision)
            )
    return moments, census


def _rows(moments: list[_Moment]) -> Rows:
    return [
        [
            m.seconds,
            n.node_id,
            n.x,
            n.y,
            n.probability,
            n.distance_index,
            n.angle_index,
            n.is_target,
        ]
        for m in moments
        for n in m.decision.end_nodes
        if n.node_id < FIRST_FRONTIER_ID
    ]


def _panel(moment: _Moment, path: Array) -> Panel:
    nodes = [n for n in moment.decision.end_nodes if n.node_id < FIRST_FRONTIER_ID]
    words = [f'{n.node_id}({n.probability:.2f})' for n in nodes]
    at = np.array([[n.x, n.y] for n in nodes]).reshape(-1, 2)
    target = moment.decision.target
    goal = (
        [] if target is None else [Curve(target.goal[None, :2], 'viewpoint', 3, '', 'X', size=9.0)]
    )
    layers: list[Layer] = [
        MapLayer(moment.patch),
        GraphLayer(moment.graph),
        Curve(path[:, :2], 'path', 5),
        *goal,
    ]
    layers += [RobotMarkers(moment.T_map_base[None]), TextLabels(at, words)]
    return Panel(layers, f'after {moment.seconds:.0f} s', limits=_SETUP.limits)
