"""map_to_graph on maps of real buildings, with chairs, glass and rough walls.

Maps of map_server beside the worlds, and, unless quick, those that replays of raw logs make.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from benchmarks.rows import Row, at_least, at_most
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.routes import route_graph
from thinmap_ros.core.topology.thinning import select_free_space
from thinmap_ros.core.topology.topology import build_along
from thinmap_ros.files.occupancy_maps import read_map, write_map
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.pipeline import PipelineConfig
from thinmap_ros.replaying import replay

Mask = NDArray[np.bool_]
_LOGS = ('intel_raw', 'aces_raw', 'csail_raw')
_CONFIG = TopologyConfig(max_unknown_gap_m=0.0)
_SHORT_M = 0.3
_PLACES = 1000
_SAMPLE_CELLS = 0.1


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows for each map: the whole skeleton, and the route graph with its targets."""
    for path in sorted((worlds.parent / 'maps').glob('*.yaml')):
        yield from _rows(path.stem, read_map(path, keeps_unknown=True))
    for name in () if quick else _LOGS:
        yield from _rows(name, _replayed(worlds.parent / 'logs' / name / 'log.clf.gz'))


def _replayed(log: Path) -> GridPatch:
    """The map of a log, as it is saved."""
    made = replay(CarmenLog(log), PipelineConfig(grid=PAPER_GRID)).pipeline.grid.known_area()
    with TemporaryDirectory() as folder:
        write_map(Path(folder) / 'map', made)
        return read_map(Path(folder) / 'map.yaml', keeps_unknown=True)


def _rows(name: str, patch: GridPatch) -> Iterator[Row]:
    standing = select_free_space(patch, None, _CONFIG)
    whole = build_along(patch, standing, None, _CONFIG)
    graph = route_graph(whole, patch, standing, _CONFIG)
    free_m2 = float(patch.free.sum()) * patch.frame.resolution**2
    yield Row(name, f'{free_m2:.0f} m2')
    yield Row('  whole skeleton: nodes, edges', f'{len(whole.nodes)}, {len(whole.edges)}')
    yield Row('  route graph: nodes, edges', f'{len(graph.nodes)}, {len(graph.edges)}')
    lengths = [math.dist(*_ends(graph, number)) for number in graph.edges]
    yield at_most(
        '  edges nearer to cells not known free than the radius', _unsafe(patch, graph), 0
    )
    short = float(np.mean(np.array(lengths) < _SHORT_M))
    yield at_most('  share of edges below 0.3 m', short, 0.02)
    yield at_most('  nodes for each m2', len(graph.nodes) / free_m2, 0.12)
    seen = _sight(patch, graph, standing)
    yield at_least('  share of places that see the nearest node', seen, 0.98)


def _ends(graph: TopologicalMap, edge_id: int) -> tuple[Array, Array]:
    edge = graph.edges[edge_id]
    return graph.nodes[edge.a].position, graph.nodes[edge.b].position


def _unsafe(patch: GridPatch, graph: TopologicalMap) -> int:
    """Edges whose straight line is nearer than the radius, less a cell, to cells not known free."""
    resolution = patch.frame.resolution
    clearance_m = ndimage.distance_transform_edt(np.pad(patch.free, 1))[1:-1, 1:-1] * resolution
    wide = clearance_m >= _CONFIG.robot_radius_m - resolution
    return sum(not _on_line(patch, wide, *_ends(graph, number)) for number in graph.edges)


def _sight(patch: GridPatch, graph: TopologicalMap, standing: Mask) -> float:
    """Share of random places, in the largest part of the free space, that see the nearest node."""
    parts, _ = ndimage.label(standing, np.ones((3, 3)))
    largest = 1 + int(np.bincount(parts[parts > 0] - 1).argmax())
    cells = np.argwhere(parts == largest)
    chosen = cells[np.random.default_rng(0).integers(0, len(cells), _PLACES)]
    places = patch.frame.centres_of(chosen)
    nodes = np.array([node.position for node in graph.nodes.values()])
    nearest = np.asarray(cKDTree(nodes).query(places)[1])
    pairs = zip(places, nodes[nearest], strict=True)
    return float(np.mean([_on_line(patch, patch.free, place, node) for place, node in pairs]))


def _on_line(patch: GridPatch, cells: Mask, a: Array, b: Array) -> bool:
    """Whether the straight line between two points stays on cells (H, W)."""
    steps = math.ceil(math.dist(a, b) / (_SAMPLE_CELLS * patch.frame.resolution)) + 2
    at = patch.frame.cells_of(a + np.linspace(0.0, 1.0, steps)[:, None] * (b - a))
    return bool(cells[at[:, 0], at[:, 1]].all())
