"""A simulated robot explores a world until no end node of the graph is left to observe.

Usage: python examples/explore_in_simulation.py [WORLD]
WORLD: a world or map_server YAML, or the name of a world of the package (default: room_10x10).
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter

from thinmap_ros import ExplorationOptions, explore


def main(name: str) -> None:
    """Explore a world and print how it went."""
    options = ExplorationOptions(localization='slam', speed_m_s=0.3, seed=1)
    robot, report = explore(name, options=options)
    print(f'{report["reason"]} after {report["time"]:.0f} s and {report["distance"]:.1f} m')
    print(f'{report["coverage"]:.1%} seen, {report["collisions"]} collisions')
    print(f'{len(robot.pipeline.topology.map.nodes)} nodes in the graph')


if __name__ == '__main__':
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument('world', nargs='?', default='room_10x10')
    main(parser.parse_args().world)
