"""map_to_graph on real floors: time, number of nodes, drivable, complete."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from benchmarks.graphs.graph_metrics import completeness, drivable_share
from benchmarks.rows import Row, at_least, at_most
from benchmarks.time_and_memory import best_seconds
from benchmarks.worlds import floors
from thinmap_ros.baselines.voronoi import build_voronoi
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.files.occupancy_maps import read_map

_SECONDS = {'kth/50052751': 0.1, 'kth/50037764_PLAN1': 0.5}
_MAX_NODES = 635 / 5  # SWAGGER: 635 on a floor of 256 x 786


def run(worlds: Path, quick: bool) -> Iterator[Row]:
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
