"""Bytes of a topological map against those of the grid, on whole floors."""

import zlib
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import NamedTuple

from benchmarks.graphs.map_sizes import graph_in_bytes, grid_as_png, grid_in_bytes
from benchmarks.rows import Row, at_least
from benchmarks.worlds import groups
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.experiments.drives import Source, grid_of
from thinmap_ros.files.occupancy_maps import read_map


class _Sizes(NamedTuple):
    """Bytes of the grid, as it is and as PNG; of the graph, as it is and compressed."""

    grid: int
    png: int
    graph: int
    packed: int


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows for each kind of floors, and for a map by scans."""
    for kind, floors in groups(worlds, 'kth' if quick else ''):
        yield Row(f'{kind}, maps without noise', f'{len(floors)} floors')
        yield from _rows([read_map(floor.path) for floor in floors])
    yield Row('lab, map from noisy scans at twelve positions', '1 floor')
    yield from _rows([grid_of(Source().samples('lab_stops')).known_area()])


def _rows(patches: list[GridPatch]) -> Iterator[Row]:
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
    shown = [f'{value:.0f}' if value >= 100 else f'{value:.3g}' for value in _range(values)]
    text = f'{shown[0]} {unit}'.strip()
    return text if len(values) == 1 else f'{text} ({shown[1]} to {shown[2]})'


def _range(values: list[float] | list[int]) -> tuple[float, float, float]:
    return float(median(values)), float(min(values)), float(max(values))
