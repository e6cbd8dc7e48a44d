"""What a route graph is worth on its map, from the two files alone.

`python -m benchmarks.graphs.route_measures MAP.yaml ...` makes the graph of each map by
map_to_graph; with `--graph FILE.geojson` it measures one that is there.

Slow, and on purpose without the code that makes graphs: only the map, NumPy and SciPy.
"""

import argparse
import json
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from benchmarks.rows import markdown
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.se2 import Array, Cells, Mask
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.files.occupancy_maps import read_map

RADIUS_M = TopologyConfig().robot_radius_m
_LATTICE_M = 0.25  # between places
_NEAREST = 5  # nodes of which a place should see one
_CLOSE_M = 1.5  # of the graph
_FAR_M = 3.0  # from a node
# The clearances of neighbouring cells differ by up to the root of 2, and ends of edges are rounded.
_OVERSTATED_CELLS = 1.5
_TOUCHED_CELLS = 0.01  # shorter pieces of a line, at corners, are on no cell
# A part of the floor is no island from this area on, or from this share of the largest one.
_PART_M2 = 2.0
_PART_SHARE = 0.05
_SOURCES = 20  # random nodes, of routes to all others
_ROUTE_M = 5.0  # shorter ways are driven over a node or two: no route is needed
_EVERYWHERE = np.ones((3, 3), dtype=np.bool_)  # cells are joined over edges and corners
STRAIGHT_AND_DIAGONAL = ((0, 1), (1, 0), (1, 1), (1, -1))  # moves on a grid, and back
_MOVES = (*STRAIGHT_AND_DIAGONAL, (1, 2), (2, 1), (2, -1), (1, -2))


@dataclass(frozen=True, eq=False)
class WrittenGraph:
    """A graph as a route server reads it: ids and xy (N, 2) of nodes, and edges.

    ends (M, 2): numbers of the nodes of each edge; length_m, clearance_m (M,): as stated.
    """

    xy: Array
    ends: Cells
    length_m: Array
    clearance_m: Array

    @property
    def straight_m(self) -> Array:
        """Lengths (M,) of the straight lines between the nodes of each edge."""
        return np.asarray(np.hypot(*(self.xy[self.ends[:, 0]] - self.xy[self.ends[:, 1]]).T))

    @property
    def links(self) -> sparse.csr_matrix:
        """Straight lengths (N, N) between nodes with an edge; of two edges the shorter."""
        order = np.argsort(-self.straight_m, kind='stable')
        shape = (len(self.xy), len(self.xy))
        links = sparse.dok_matrix(shape)
        for (a, b), length in zip(self.ends[order], self.straight_m[order], strict=True):
            links[a, b] = length
        return links.tocsr()


@dataclass(frozen=True)
class RouteMeasures:
    """Counts and shares of a route graph on its map; the names of the columns of a table.

    places: cells 0.25 m apart on which a robot can stand, in parts of the floor that are no
    islands. unseeing: those that see none of their 5 nearest nodes. elsewhere: those whose nearest
    node stands on another part of the floor. far: share more than 3 m from the nearest node.
    covered: share of the floor within 1.5 m of the graph. unsafe: edges whose straight line is
    nearer than the radius to a cell that is not known to be free. inscribed: edges over cells that
    Nav2's inflation layer calls inscribed. overlong, overwide: edges whose stated length, clearance
    is more than 1.5 cells above that of the straight line. parts, floor_parts: of the graph and the
    floor. route_median, route_worst: lengths between nodes that are 5 m or more apart, relative to
    the shortest paths on the grid; NaN without such a pair.
    """

    floor_m2: float
    nodes: int
    edges: int
    parts: int
    floor_parts: int
    places: int
    unseeing: int
    elsewhere: int
    far: float
    covered: float
    unsafe: int
    inscribed: int
    overlong: int
    overwide: int
    route_median: float
    route_worst: float


def distance_m(cells: Mask, frame: GridFrame) -> Array:
    """Distance (H, W) of each cell from the nearest other one; cells outside are others."""
    away = ndimage.distance_transform_edt(np.pad(cells, 1))[1:-1, 1:-1]
    return np.asarray(away * frame.resolution)


class _Floor:
    """Where a robot can stand on a map, by the map alone.

    open_m, clearance_m (H, W): distance from the nearest cell centre that is occupied, and that is
    not known to be free. part (H, W): number of the part of the floor, 0 where no robot can stand.
    is_reachable (H, W): parts that are no islands.
    """

    def __init__(self, patch: GridPatch, radius_m: float) -> None:
        self.frame = patch.frame
        self.free = patch.free
        self.clearance_m = distance_m(patch.free, patch.frame)
        self.open_m = distance_m(~patch.occupied, patch.frame)
        # Nav2's inflation layer: a cell at just the radius from an obstacle is inscribed.
        self.is_inscribed = self.open_m <= radius_m + 1e-9
        self.is_too_near = self.clearance_m < radius_m - 1e-9
        self.part, count = ndimage.label(~self.is_inscribed & ~self.is_too_near, _EVERYWHERE)
        area_m2 = np.bincount(self.part.ravel(), minlength=count + 1) * patch.frame.resolution**2
        area_m2[0] = 0.0
        is_large = (area_m2 >= _PART_M2) | (area_m2 >= _PART_SHARE * area_m2.max())
        is_large[0] = False
        self.is_reachable: Mask = is_large[self.part]
        self.parts = int(is_large.sum())

    def parts_at(self, xy: Array) -> NDArray[np.int64]:
        """Part of the floor (N,) nearest to each of some points (N, 2)."""
        rows, cols = ndimage.distance_transform_edt(
            self.part == 0, return_distances=False, return_indices=True
        )
        row, col = self.frame.cells_of(xy).T
        return np.asarray(self.part[rows[row, col], cols[row, col]])


def read_graph(path: Path) -> WrittenGraph:
    """Read the nodes and edges of a GeoJSON file; an edge in both directions is read twice."""
    features = json.loads(path.read_text(encoding='utf-8'))['features']
    points = [f for f in features if f['geometry']['type'] == 'Point']
    lines = [f['properties'] for f in features if 'startid' in f['properties']]
    number = {f['properties']['id']: k for k, f in enumerate(points)}
    stated = np.array([_stated(line) for line in lines]).reshape(-1, 2)
    ends = [(number[line['startid']], number[line['endid']]) for line in lines]
    return WrittenGraph(
        np.array([f['geometry']['coordinates'] for f in points], dtype=float).reshape(-1, 2),
        np.array(ends, dtype=np.int64).reshape(-1, 2),
        stated[:, 0],
        stated[:, 1],
    )


def _stated(line: dict[str, Any]) -> tuple[float, float]:
    return line['metadata']['length'], line['metadata']['clearance']


def measure(patch: GridPatch, graph: WrittenGraph, radius_m: float = RADIUS_M) -> RouteMeasures:
    """Measure a route graph on its map, for a robot of a radius."""
    floor = _Floor(patch, radius_m)
    cell_m = patch.frame.resolution
    crossed = [_cells_on_line(floor.frame, *graph.xy[list(ends)]) for ends in graph.ends]
    smallest_m = np.array([_at(floor.clearance_m, cells).min() for cells in crossed])
    places = _places(floor)
    xy = floor.frame.centres_of(places)
    away, nearest = _nearest(graph.xy, xy)
    node_parts = floor.parts_at(graph.xy)
    ratios = _route_ratios(floor, graph)
    limit_m = _OVERSTATED_CELLS * cell_m
    return RouteMeasures(
        floor_m2=float(floor.is_reachable.sum()) * cell_m**2,
        nodes=len(graph.xy),
        edges=len(graph.ends) // 2,
        parts=int(csgraph.connected_components(graph.links, directed=False)[0]),
        floor_parts=floor.parts,
        places=len(places),
        unseeing=sum(
            not any(_sees(floor, place, graph.xy[k]) for k in around)
            for place, around in zip(xy, nearest, strict=True)
        ),
        elsewhere=int((node_parts[nearest[:, :1]] != _at(floor.part, places)[:, None]).sum()),
        far=float((away[:, :1] > _FAR_M).mean()),
        covered=_covered(floor, crossed, graph),
        unsafe=_count(floor.is_too_near, crossed) // 2,
        inscribed=_count(floor.is_inscribed, crossed) // 2,
        overlong=int((graph.length_m > graph.straight_m + limit_m).sum()) // 2,
        overwide=int((graph.clearance_m > smallest_m + limit_m).sum()) // 2,
        route_median=float(np.median(ratios)) if len(ratios) else math.nan,
        route_worst=float(ratios.max(initial=0.0)) if len(ratios) else math.nan,
    )


def _at(field: NDArray[Any], cells: Cells) -> NDArray[Any]:
    """Values (N,) of a field (H, W) at cells (N, 2)."""
    return np.asarray(field[cells[:, 0], cells[:, 1]])


def _count(is_bad: Mask, crossed: list[Cells]) -> int:
    """Number of lines, by the cells (K, 2) that they cross, over one that is bad."""
    return sum(bool(_at(is_bad, cells).any()) for cells in crossed)


def _places(floor: _Floor) -> Cells:
    """Cells (N, 2) of a lattice on the reachable floor."""
    step = max(round(_LATTICE_M / floor.frame.resolution), 1)
    cells = np.argwhere(floor.is_reachable)
    return np.asarray(cells[(cells % step == 0).all(axis=1)])


def _nearest(nodes: Array, xy: Array) -> tuple[Array, NDArray[np.int64]]:
    """Distances (N, k) and numbers (N, k) of the nearest nodes of points (N, 2), nearest first."""
    away, number = cKDTree(nodes).query(xy, min(_NEAREST, len(nodes)))
    shape = (len(xy), -1)
    return np.asarray(away).reshape(shape), np.asarray(number).reshape(shape)


def _cells_on_line(frame: GridFrame, a: Array, b: Array) -> Cells:
    """Cells (K, 2) that the straight line between two points (2,) crosses."""
    start = (a - (frame.origin_x, frame.origin_y)) / frame.resolution
    end = (b - (frame.origin_x, frame.origin_y)) / frame.resolution
    cuts = [0.0, 1.0]
    for from_, to in zip(start.tolist(), end.tolist(), strict=True):
        low, high = sorted((from_, to))
        borders = np.arange(math.ceil(low), math.floor(high) + 1)
        if high > low:
            cuts += ((borders - from_) / (to - from_)).tolist()
    at = np.sort(np.clip(cuts, 0.0, 1.0))
    long_enough = np.diff(at) * math.dist(start, end) > _TOUCHED_CELLS
    middles = 0.5 * (at[1:] + at[:-1])[long_enough]
    points = start + middles[:, None] * (end - start) if len(middles) else start[None]
    return np.floor(points[:, ::-1]).astype(np.int64)


def _sees(floor: _Floor, place: Array, node: Array) -> bool:
    """Whether the straight line between two points (2,) crosses only free cells."""
    return bool(_at(floor.free, _cells_on_line(floor.frame, place, node)).all())


def _covered(floor: _Floor, crossed: list[Cells], graph: WrittenGraph) -> float:
    """Share of the reachable cells near a node or an edge."""
    is_off = np.ones(floor.free.shape, dtype=np.bool_)
    for cells in (*crossed, floor.frame.cells_of(graph.xy)):
        is_off[cells[:, 0], cells[:, 1]] = False
    away_m = ndimage.distance_transform_edt(is_off) * floor.frame.resolution
    return float((away_m <= _CLOSE_M)[floor.is_reachable].mean())


def _route_ratios(floor: _Floor, graph: WrittenGraph) -> Array:
    """Lengths (N,) of routes between random nodes, relative to the shortest paths on the grid."""
    cells = np.argwhere(floor.part > 0)
    at_nodes = np.asarray(cKDTree(floor.frame.centres_of(cells)).query(graph.xy)[1])
    paths = grid_links(floor.part > 0, _MOVES)
    count = min(_SOURCES, len(graph.xy))
    sources = np.random.default_rng(0).choice(len(graph.xy), count, replace=False)
    routes = csgraph.dijkstra(graph.links, directed=False, indices=sources)
    shortest = np.array(
        [csgraph.dijkstra(paths, directed=False, indices=k)[at_nodes] for k in at_nodes[sources]]
    )
    shortest *= floor.frame.resolution
    is_route = np.isfinite(shortest) & (shortest >= _ROUTE_M)
    return np.asarray(routes[is_route] / shortest[is_route])


def numbered(cells: Mask) -> Cells:
    """Numbers (H, W) of cells, row after row; -1 for others."""
    number = np.full(cells.shape, -1)
    number[cells] = np.arange(cells.sum())
    return number


def grid_links(cells: Mask, moves: Sequence[tuple[int, int]]) -> sparse.csr_matrix:
    """Steps between cells (H, W), in cells, by their numbers; moves: to rows below, and columns.

    A step over two others, as a knight's move, needs both.
    """
    number = numbered(cells)
    steps = [_steps(number, down, right) for down, right in moves]
    a, b, lengths = (np.concatenate(part) for part in zip(*steps, strict=True))
    count = int(cells.sum())
    return sparse.csr_matrix((lengths, (a, b)), shape=(count, count))


def _steps(number: Cells, down: int, right: int) -> tuple[Cells, Cells, Array]:
    """Both ends of all steps of one kind, and their lengths, from numbers (H, W) of cells."""
    padded = np.pad(number, 2, constant_values=-1)
    rows, cols = number.shape

    def moved(row: float, col: float) -> Cells:
        return np.asarray(padded[2 + int(row) :, 2 + int(col) :][:rows, :cols])

    there = moved(down, right)
    is_free = (number >= 0) & (there >= 0)
    if max(abs(down), abs(right)) == 2:
        side = (down - np.sign(down), right - np.sign(right))  # after a step to the diagonal
        is_free &= moved(*side) >= 0
        is_free &= moved(np.sign(down), np.sign(right)) >= 0
    ends = (number[is_free], there[is_free])
    return *ends, np.full(len(ends[0]), math.hypot(down, right))


def made(path: Path, options: Sequence[str | Path] = ()) -> WrittenGraph:
    """The graph that map_to_graph makes of a map, with some options."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / 'graph.geojson'
        program = [sys.executable, '-m', 'thinmap_ros', 'map_to_graph']
        subprocess.run(
            [*program, path, '-o', out, '--quiet', *options],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        return read_graph(out)


def maps_below(folder: Path) -> list[Path]:
    """The descriptions of all maps in a folder and below."""
    return sorted(folder.rglob('*.yaml'))


def table(rows: dict[str, RouteMeasures]) -> str:
    """A table in Markdown: a row for each map, by name."""
    names = [field.name for field in fields(RouteMeasures)]
    cells = [[name, *map(_shown, astuple(row))] for name, row in rows.items()]
    return markdown(['map', *names], cells)


def _shown(value: float) -> str:
    return str(value) if isinstance(value, int) else f'{value:.3g}'


def main() -> None:
    """Print the measures of the graphs of some maps."""
    parser = argparse.ArgumentParser(prog='route_measures', description=__doc__)
    parser.add_argument('maps', type=Path, nargs='+', metavar='MAP', help='YAML files, or folders')
    parser.add_argument('--graph', type=Path, help='GeoJSON of the one map (default: it is made)')
    parser.add_argument('--robot-radius-m', type=float, default=RADIUS_M)
    parser.add_argument('--options', default='', help='of map_to_graph, in one word')
    arguments = parser.parse_args()
    options = [f'--robot-radius-m={arguments.robot_radius_m}', *arguments.options.split()]
    rows = {}
    for given in arguments.maps:
        for path in maps_below(given) if given.is_dir() else [given]:
            graph = read_graph(arguments.graph) if arguments.graph else made(path, options)
            patch = read_map(path, report=str, keeps_unknown=True)  # map_to_graph has reported
            rows[path.stem] = measure(patch, graph, arguments.robot_radius_m)
    print(table(rows))


if __name__ == '__main__':
    main()
