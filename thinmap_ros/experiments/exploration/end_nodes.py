"""Paper 2, Fig. 5 and 6: an end node moves until its surroundings are explored."""

import math
from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid, WindowConfig
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import TopologyBuilder
from thinmap_ros.evaluation.outcome import Comparison, Outcome, Table
from thinmap_ros.experiments.drives import Source, world_of
from thinmap_ros.sim.world import surfaces
from thinmap_ros.view.plots import (
    Curve,
    GraphLayer,
    Layer,
    MapLayer,
    Panel,
    Plot,
    RobotMarkers,
    TextLabels,
    xy,
)

_FIGURES = {'dead_end': 'Fig. 5', 'joined_hallways': 'Fig. 6'}


@dataclass(frozen=True)
class _Setup:
    """Node A and the pictures.

    shown: moments of the pictures, as shares of the drive. bend: x and y, m; A is at first the end
    node nearest to it. jump_m: A continues as the nearest end node up to this distance.
    rest_m: A rests within this distance of its final position. margin_m: around the world.
    """

    shown: tuple[float, ...]
    bend: tuple[float, float]
    jump_m: float
    rest_m: float
    margin_m: float


_SETUP = _Setup(shown=(0.0, 0.6, 1.0), bend=(0.0, 9.0), jump_m=3.0, rest_m=0.2, margin_m=0.4)


def run(source: Source) -> Outcome:
    """Follow the end node ahead in both hallways."""
    plots = []
    rows = []
    ends = {}
    curves = []
    for k, (name, figure) in enumerate(_FIGURES.items()):
        moments, track = _follow(source, name)
        rows += [[name, *line] for line in track]
        line = np.array(track)
        ends[name] = (line, _rest(line))
        last = len(moments) - 1
        shown = [moments[round(share * last)] for share in _SETUP.shown]
        caption = (
            f'Paper 2, {figure}: the topological map while the robot drives up the hallway; '
            'A is the end node that is followed.'
        )
        panels = [_panel(moment, _limits(name)) for moment in shown]
        plots.append(Plot(name, caption, panels, columns=3, panel_inches=(4.6, 3.6)))
        moved = np.hypot(*(line[:, 1:3] - line[0, 1:3]).T)
        curves.append(Curve(xy(line[:, 3], moved), name.replace('_', ' '), k, ('-', '--')[k]))
    panel = Panel(
        curves,
        '',
        'travelled distance (m)',
        'distance of node A from its first position (m)',
        plan=False,
    )
    caption = 'Paper 2, to Fig. 5 and 6: displacement of node A.'
    plots.append(Plot('movement', caption, [panel], panel_inches=(6.5, 3.6), legend='inside'))
    (dead, dead_rest) = ends['dead_end']
    (joined, joined_rest) = ends['joined_hallways']
    return Outcome(
        'Motion of end nodes during exploration',
        'Exploration paper, section 3.1, Fig. 5 and 6',
        'The robot drives up a hallway and turns left into a part that is hidden from its start: '
        'a dead end, or the connection to another hallway. Node A is the end node ahead of it.',
        [Table('node_a', ['world', 'time_s', 'x_m', 'y_m', 'way_m'], rows)],
        plots,
        [
            Comparison(
                'dead end: node A moves, then rests',
                'yes',
                f'moves {_moved(dead):.1f} m, '
                f'rests after {dead_rest:.1f} m of {dead[-1, 3]:.1f} m driven',
                bool(_moved(dead) > 1.0 and dead_rest < dead[-1, 3] - 0.5),
            ),
            Comparison(
                'joined hallways: node A moves into the other one',
                'yes',
                f'moves {_moved(joined):.1f} m, to ({joined[-1, 1]:.1f} m, {joined[-1, 2]:.1f} m)',
                _moved(joined) > _moved(dead) and joined_rest > dead_rest,
            ),
        ],
    )


Moment = tuple[float, Array, GridPatch, TopologicalMap, Array]


def _follow(source: Source, name: str) -> tuple[list[Moment], list[list[float]]]:
    """State once a second (time, pose, map, graph, node A); A by scan: time, x, y, path."""
    builder = TopologyBuilder(TopologyConfig())
    grid = OccupancyGrid(PAPER_GRID)
    moments: list[Moment] = []
    track: list[list[float]] = []
    at = np.array(_SETUP.bend)
    travelled_m = 0.0
    window_m = WindowConfig().local_map_size_m
    last = None
    for k, sample in enumerate(source.samples(name)):
        T = sample.T_world_base
        travelled_m += 0.0 if last is None else math.dist(T[:2], last[:2])
        last = T
        grid.add_scan(sample.scan, T)
        builder.update(grid.window(float(T[0]), float(T[1]), window_m), T)
        places = np.array(
            [n.position for n in builder.map.nodes.values() if n.kind == NodeKind.END]
        ).reshape(-1, 2)
        away = np.hypot(*(places - at).T)
        if away.min(initial=np.inf) <= _SETUP.jump_m:
            at = places[int(away.argmin())]
            seconds = sample.scan.stamp_ns / 1e9
            track.append([seconds, float(at[0]), float(at[1]), travelled_m])
            if k % 5 == 0:
                moments.append((seconds, T, grid.known_area(), builder.map.copy(), at))
    return moments, track


def _limits(name: str) -> tuple[float, float, float, float]:
    """Bounds of a world, x, x, y, y, with some margin, m."""
    corners = surfaces(world_of(name), _SETUP.margin_m).reshape(-1, 2)
    (left, bottom) = corners.min(axis=0) - _SETUP.margin_m
    (right, top) = corners.max(axis=0) + _SETUP.margin_m
    return float(left), float(right), float(bottom), float(top)


def _panel(moment: Moment, limits: tuple[float, float, float, float]) -> Panel:
    seconds, T, patch, graph, at = moment
    layers: list[Layer] = [
        MapLayer(patch),
        GraphLayer(graph),
        RobotMarkers(T[None]),
        TextLabels(at[None], ['A'], 11.0),
    ]
    return Panel(layers, f'after {seconds:.0f} s', limits=limits)


def _moved(track: Array) -> float:
    return float(np.hypot(*(track[:, 1:3] - track[0, 1:3]).T).max())


def _rest(track: Array) -> float:
    """Travelled distance at which node A reached its final position, m."""
    off = np.hypot(*(track[:, 1:3] - track[-1, 1:3]).T) > _SETUP.rest_m
    moving = np.flatnonzero(off)
    return float(track[moving[-1], 3]) if moving.size else 0.0
