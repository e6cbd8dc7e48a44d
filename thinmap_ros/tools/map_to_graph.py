"""Converts a map_server map to a route graph."""

import argparse
import math
import sys
from pathlib import Path

import numpy as np

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.regions.config import RegionConfig
from thinmap_ros.core.regions.membership import membership_of
from thinmap_ros.core.regions.segmentation import find_regions
from thinmap_ros.core.topology.builder import TopologyConfig, build
from thinmap_ros.files import graphs, occupancy_maps
from thinmap_ros.tools import cli
from thinmap_ros.view.summary import summary_figure

_DEFAULTS = TopologyConfig()


def _start(given: str | None) -> tuple[float, float] | None:
    if given is None:
        return None
    try:
        x, y = (float(word) for word in given.split(','))
    except ValueError:
        x = y = math.nan
    if not (math.isfinite(x) and math.isfinite(y)):
        raise InputError(f'--start={given}: expected two finite numbers X,Y (m, map frame)')
    return x, y


def _config(arguments: argparse.Namespace) -> TopologyConfig:
    """Configuration from the arguments: a greater clearance is a wider robot."""
    radius = arguments.robot_radius if arguments.min_clearance is None else arguments.min_clearance
    if radius < arguments.robot_radius:
        raise InputError(
            f'--min-clearance {radius}: '
            f'expected at least the robot radius ({arguments.robot_radius} m)'
        )
    return TopologyConfig(robot_radius_m=radius, min_branch_length_m=arguments.prune)


def _work(arguments: argparse.Namespace) -> None:
    graphs.writer_of(arguments.out)  # report a wrong name before the work
    if arguments.picture is not None and arguments.picture.suffix != '.png':
        raise InputError(f'{arguments.picture}: expected a name that ends in .png')
    start = _start(arguments.start)
    config = _config(arguments)
    patch = occupancy_maps.read_map(arguments.map, keeps_unknown=True)
    topology = build(patch, start, config)
    regions = find_regions(patch, RegionConfig(robot_radius_m=arguments.robot_radius))
    graphs.write_graph(arguments.out, topology, membership_of(topology, regions))
    if arguments.picture is not None:
        summary_figure(
            arguments.picture,
            patch,
            topology,
            np.empty((0, 2)),
            title=arguments.map.stem,
            regions=regions,
            is_measured=False,
        )
    if not topology.nodes:
        place = 'no free place' if start is None else f'no free place round {start}'
        print(
            f'map_to_graph: warning: {arguments.map}: {place} '
            f'for a robot of {config.robot_radius_m} m radius: the graph is empty',
            file=sys.stderr,
        )
    parts = len(topology.components())
    print(
        f'{arguments.out}: {len(topology.nodes)} nodes, {len(topology.edges)} edges, '
        f'connected parts: {parts}, regions: {len(regions.regions)}'
    )


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(prog='map_to_graph', description=__doc__)
    parser.add_argument('map', type=Path, help='map_server YAML file')
    out_help = 'FILE.geojson (Nav2 route server), .graphml, or .tmap2.yaml (topological_navigation)'
    parser.add_argument('-o', '--out', type=Path, required=True, help=out_help)
    radius = _DEFAULTS.robot_radius_m
    parser.add_argument('--robot-radius', type=float, default=radius, help=f'm (default {radius})')
    clearance_help = 'how far nodes and edges stay from obstacles, m (default: the robot radius)'
    parser.add_argument('--min-clearance', type=float, help=clearance_help)
    default = _DEFAULTS.min_branch_length_m
    prune_help = f'shorter branches of the skeleton are pruned, m (default {default})'
    parser.add_argument(
        '--prune', type=float, default=_DEFAULTS.min_branch_length_m, help=prune_help
    )
    parser.add_argument(
        '--start', help='X,Y in m: only what a robot can reach from there (default: all parts)'
    )
    parser.add_argument('--picture', type=Path, help='FILE.png: the graph drawn on the map')
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
