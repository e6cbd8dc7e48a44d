"""Thinning against the Voronoi diagram on whole floors, by equal rules from their lines on."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from scipy import ndimage

from benchmarks.graphs.graph_metrics import (
    Mask,
    completeness,
    drivable_share,
    hole_count,
    loop_count,
    sight_share,
)
from benchmarks.rows import Row, at_least
from benchmarks.time_and_memory import median_seconds
from benchmarks.worlds import Floor, groups
from thinmap_ros.baselines.voronoi import build_voronoi, voronoi_lines
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.thinning import select_free_space, thin
from thinmap_ros.core.topology.topology import build
from thinmap_ros.files.occupancy_maps import read_map

_CONFIG = TopologyConfig()
_PLACES = 1000
_PAIRS = 50
_QUICK_PAIRS = 5
_TIMED_RUNS = 3


@dataclass
class _Figures:
    """Figures of one method, of each floor."""

    kinds: list[list[int]] = field(default_factory=list)
    edges: list[int] = field(default_factory=list)
    is_same_topology: list[bool] = field(default_factory=list)
    drivable: list[float] = field(default_factory=list)
    sight: list[float] = field(default_factory=list)
    joined: list[float] = field(default_factory=list)
    lengths: list[float] = field(default_factory=list)
    skeleton_s: list[float] = field(default_factory=list)
    graph_s: list[float] = field(default_factory=list)


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows for each kind of floors."""
    for kind, floors in groups(worlds, 'kth' if quick else ''):
        figures = {'thinning': _Figures(), 'Voronoi': _Figures()}
        for floor in floors:
            _measure(floor, figures, _QUICK_PAIRS if quick else _PAIRS)
        yield Row(kind, f'{len(floors)} floors')
        yield from _rows(figures)


def _measure(floor: Floor, figures: dict[str, _Figures], pairs: int) -> None:
    patch = read_map(floor.path)
    free = select_free_space(patch, None, _CONFIG)
    skeletons: dict[str, Callable[[], Mask]] = {
        'thinning': partial(thin, free),
        'Voronoi': partial(voronoi_lines, patch, free, _CONFIG),
    }
    builds: dict[str, Callable[[], TopologicalMap]] = {
        'thinning': partial(build, patch, None, _CONFIG),
        'Voronoi': partial(build_voronoi, patch, _CONFIG),
    }
    for name, one in figures.items():
        one.skeleton_s.append(median_seconds(skeletons[name], _TIMED_RUNS))
        one.graph_s.append(median_seconds(builds[name], _TIMED_RUNS))
        _add_graph(one, patch, free, builds[name](), pairs)


def _add_graph(
    one: _Figures, patch: GridPatch, free: Mask, graph: TopologicalMap, pairs: int
) -> None:
    kinds = [node.kind for node in graph.nodes.values()]
    one.kinds.append([kinds.count(kind) for kind in NodeKind])
    one.edges.append(len(graph.edges))
    parts = ndimage.label(free, np.ones((3, 3)))[1]
    found = (loop_count(graph), len(graph.components()))
    one.is_same_topology.append(found == (hole_count(free), parts))
    one.drivable.append(drivable_share(patch, graph, _CONFIG.robot_radius_m))
    one.sight.append(sight_share(patch, graph, free, _PLACES, 0))
    joined, length = completeness(patch, graph, _CONFIG.robot_radius_m, pairs, 0)
    one.joined.append(joined)
    one.lengths.append(length)


def _rows(figures: dict[str, _Figures]) -> Iterator[Row]:
    shown: dict[str, Callable[[_Figures], str]] = {
        'nodes': lambda one: str(np.sum(one.kinds)),
        'end, branch and corner nodes': lambda one: _joined(np.sum(one.kinds, axis=0).tolist()),
        'edges': lambda one: str(sum(one.edges)),
        'floors with the topology of the free space': _same,
        'share of drivable edges, mean and minimum': lambda one: _mean_and(one.drivable, min),
        'share of free positions in sight of a node, mean and minimum': lambda one: _mean_and(
            one.sight, min
        ),
        'share of connected pairs, mean and minimum': lambda one: _mean_and(one.joined, min),
        'path length / shortest on the grid, mean and maximum': lambda one: _mean_and(
            one.lengths, max
        ),
        'CPU time of the skeleton': lambda one: f'{sum(one.skeleton_s):.3g} s',
        'CPU time of the graph': lambda one: f'{sum(one.graph_s):.3g} s',
    }
    for what, text in shown.items():
        for name, one in figures.items():
            yield Row(f'  {what}: {name}', text(one))
    thinning, voronoi = figures.values()
    faster = sum(voronoi.skeleton_s) / sum(thinning.skeleton_s)
    yield at_least('  skeleton by thinning: times faster', faster, 1.0)
    faster = sum(voronoi.graph_s) / sum(thinning.graph_s)
    yield at_least('  graph by thinning: times faster', faster, 1.0)


def _same(one: _Figures) -> str:
    return f'{sum(one.is_same_topology)} of {len(one.is_same_topology)}'


def _joined(numbers: list[int]) -> str:
    return ', '.join(map(str, numbers))


def _mean_and(values: list[float], extreme: Callable[[list[float]], float]) -> str:
    return f'{np.mean(values):.4g}, {extreme(values):.4g}'
