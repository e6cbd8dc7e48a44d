"""Graphs of whole floors: time and size, bytes against the grid, and the Voronoi diagram."""

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from io import BytesIO
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.graphs.graph_metrics import (
    Mask,
    completeness,
    drivable_share,
    hole_count,
    loop_count,
    sight_share,
)
from benchmarks.rows import Row, at_least, at_most
from benchmarks.time_and_memory import best_seconds, median_seconds
from benchmarks.worlds import Floor, floors, groups
from thinmap_ros.baselines.voronoi import build_voronoi, voronoi_lines
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.thinning import select_free_space, thin
from thinmap_ros.core.topology.topology import build
from thinmap_ros.experiments.drives import Source, grid_of
from thinmap_ros.files.occupancy_maps import read_map

_SECONDS = {'kth/50052751': 0.1, 'kth/50037764_PLAN1': 0.5}
_MAX_NODES = 635 / 5  # SWAGGER: 635 on a floor of 256 x 786


def graphs(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows for each world, as they come."""
    config = TopologyConfig()
    for floor in floors(worlds, 'kth' if quick else ''):

        def work(path: Path = floor.path) -> TopologicalMap:
            return build(read_map(path), None, config)

        graph = work()
        patch = read_map(floor.path)
        yield Row(floor.name, f'{len(graph.nodes)} nodes')
        if floor.name in _SECONDS:
            seconds = best_seconds({'work': work}, 5)['work']
            yield at_most('  time from map to graph', seconds, _SECONDS[floor.name], 's')
            voronoi = best_seconds({'work': partial(build_voronoi, patch)}, 1)['work']
            yield at_least('  times faster than a Voronoi graph (SciPy)', voronoi / seconds, 1.0)
        if floor.name == 'kth/50052751':
            yield at_most('  nodes', len(graph.nodes), _MAX_NODES)
        yield at_least(
            '  share of drivable edges', drivable_share(patch, graph, config.robot_radius_m), 1.0
        )
        joined, ratio = completeness(patch, graph, config.robot_radius_m, 50 if quick else 1000, 0)
        yield at_least('  share of reachable pairs that are connected', joined, 0.995)
        yield at_most('  path length / shortest on the grid, sums', ratio, 1.15)


# Little-endian, without padding, with the types of thinmap_msgs; places are float32 as in a path.
_NODE = np.dtype([('id', '<u4'), ('kind', 'u1'), ('xy', '<f4', 2), ('clearance', '<f4')])
_EDGE = np.dtype([('id', '<u4'), ('ends', '<u4', 2), ('length', '<f4'), ('clearance', '<f4')])
_PLACE = np.dtype(('<f4', 2))
_COUNT = np.dtype('<u4')


def graph_in_bytes(graph: TopologicalMap, with_paths: bool) -> bytes:
    """What a robot needs to plan on a topological map.

    A node has 17 bytes: id, kind, x, y, clearance. An edge has 20: id, ids of its nodes, length,
    smallest clearance. with_paths: a count of 4 bytes and the x and y, 8 bytes, of each place of
    its path follow.
    """
    nodes = [(node.id, node.kind, node.position, node.clearance_m) for node in graph.nodes.values()]
    edges = [
        (edge.id, (edge.a, edge.b), edge.length_m, edge.clearance_m)
        for edge in graph.edges.values()
    ]
    parts = [np.array(nodes, dtype=_NODE).tobytes(), np.array(edges, dtype=_EDGE).tobytes()]
    if with_paths:
        for edge in graph.edges.values():
            parts.append(np.array(len(edge.path), dtype=_COUNT).tobytes())
            parts.append(edge.path.astype(_PLACE.base).tobytes())
    return b''.join(parts)


def grid_in_bytes(patch: GridPatch) -> bytes:
    """Cells, a byte each as in nav_msgs/OccupancyGrid, of the smallest rectangle with all known."""
    return _known_cells(patch).tobytes()


def grid_as_png(patch: GridPatch) -> bytes:
    """The same cells as a PNG image of 8 bit."""
    from PIL import Image  # imported here: most processes never write a map

    stream = BytesIO()
    Image.fromarray(_known_cells(patch).view(np.uint8)).save(stream, 'PNG', optimize=True)
    return stream.getvalue()


def _known_cells(patch: GridPatch) -> NDArray[np.int8]:
    known = np.argwhere(patch.cells >= 0)
    if not len(known):
        raise InputError('map without known cells: it has no size')
    low = known.min(axis=0)
    high = known.max(axis=0) + 1
    return np.ascontiguousarray(patch.trinary()[low[0] : high[0], low[1] : high[1]])


class _Sizes(NamedTuple):
    """Bytes of the grid, as it is and as PNG; of the graph, as it is and compressed."""

    grid: int
    png: int
    graph: int
    packed: int


def compactness(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows for each kind of floors, and for a map by scans."""
    for kind, some in groups(worlds, 'kth' if quick else ''):
        yield Row(f'{kind}, maps without noise', f'{len(some)} floors')
        yield from _rows_of_sizes([read_map(floor.path) for floor in some])
    yield Row('lab, map from noisy scans at twelve positions', '1 floor')
    yield from _rows_of_sizes([grid_of(Source().samples('lab_stops')).known_area()])


def _rows_of_sizes(patches: list[GridPatch]) -> Iterator[Row]:
    for with_paths in (False, True):
        sizes = [_sizes(patch, with_paths) for patch in patches]
        if not with_paths:
            yield Row('  grid', _spread([size.grid for size in sizes], 'bytes'))
            yield Row('  grid as PNG', _spread([size.png for size in sizes], 'bytes'))
        name = 'with paths' if with_paths else 'without paths'
        yield Row(f'  graph {name}', _spread([size.graph for size in sizes], 'bytes'))
        yield Row(f'  graph {name}, compressed', _spread([size.packed for size in sizes], 'bytes'))
        ratios = [size.grid / size.graph for size in sizes]
        smaller = at_least(f'  grid / graph {name}', min(ratios), 1.0)
        yield Row(smaller.what, _spread(ratios), smaller.target, smaller.good)
        ratios = [size.png / size.packed for size in sizes]
        yield Row(f'  grid as PNG / graph {name}, compressed', _spread(ratios))


def _sizes(patch: GridPatch, with_paths: bool) -> _Sizes:
    graph = graph_in_bytes(build(patch, None, TopologyConfig()), with_paths)
    packed = len(zlib.compress(graph, 9))
    return _Sizes(len(grid_in_bytes(patch)), len(grid_as_png(patch)), len(graph), packed)


def _spread(values: list[float] | list[int], unit: str = '') -> str:
    """Median, smallest and largest value."""
    three = (float(median(values)), float(min(values)), float(max(values)))
    shown = [f'{value:.0f}' if value >= 100 else f'{value:.3g}' for value in three]
    text = f'{shown[0]} {unit}'.strip()
    return text if len(values) == 1 else f'{text} ({shown[1]} to {shown[2]})'


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


def voronoi(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows for each kind of floors."""
    for kind, some in groups(worlds, 'kth' if quick else ''):
        figures = {'thinning': _Figures(), 'Voronoi': _Figures()}
        for floor in some:
            _measure(floor, figures, _QUICK_PAIRS if quick else _PAIRS)
        yield Row(kind, f'{len(some)} floors')
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
        'end, branch and corner nodes': lambda one: ', '.join(map(str, np.sum(one.kinds, axis=0))),
        'edges': lambda one: str(sum(one.edges)),
        'floors with the topology of the free space': lambda one: (
            f'{sum(one.is_same_topology)} of {len(one.is_same_topology)}'
        ),
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
    thinning, theirs = figures.values()
    faster = sum(theirs.skeleton_s) / sum(thinning.skeleton_s)
    yield at_least('  skeleton by thinning: times faster', faster, 1.0)
    faster = sum(theirs.graph_s) / sum(thinning.graph_s)
    yield at_least('  graph by thinning: times faster', faster, 1.0)


def _mean_and(values: list[float], extreme: Callable[[list[float]], float]) -> str:
    return f'{np.mean(values):.4g}, {extreme(values):.4g}'
