"""A map_server map becomes a route graph."""

import argparse
from pathlib import Path

from thinmap_ros.adapters import graph_files, map_files
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.topology.update import TopologyConfig, build
from thinmap_ros.tools import cli


def _work(arguments: argparse.Namespace) -> None:
    if arguments.out.suffix != '.geojson':
        raise InputError(f'{arguments.out}: expected a name that ends in .geojson')
    config = TopologyConfig(robot_radius_m=arguments.robot_radius)
    topology = build(map_files.read_map(arguments.map), None, config)
    graph_files.write_geojson(arguments.out, topology)
    print(f'{arguments.out}: {len(topology.nodes)} nodes, {len(topology.edges)} edges')


def main() -> None:
    """Run the program."""
    default = TopologyConfig().robot_radius_m
    parser = argparse.ArgumentParser(prog='map_to_graph', description=__doc__)
    parser.add_argument('map', type=Path, help='map_server YAML file')
    parser.add_argument('-o', '--out', type=Path, required=True, help='FILE.geojson, for Nav2 route server')
    parser.add_argument('--robot-radius', type=float, default=default, help=f'm (default {default})')
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
