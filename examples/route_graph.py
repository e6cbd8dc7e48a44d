"""A map becomes a route graph, and the graph gives the shortest path between two places.

Usage: python examples/route_graph.py MAP.yaml START_X,START_Y GOAL_X,GOAL_Y
MAP.yaml: any map of map_server; places in m in the map frame.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path

from thinmap_ros import TopologyConfig, build_topology, read_map, shortest_path


def main(map_file: Path, start_xy: str, goal_xy: str) -> None:
    """Build the graph of a map and print the path between the nodes nearest to two places."""
    graph = build_topology(read_map(map_file), None, TopologyConfig(robot_radius_m=0.2))
    start = graph.nearest_node(*map(float, start_xy.split(',')))
    goal = graph.nearest_node(*map(float, goal_xy.split(',')))
    if start is None or goal is None:
        print('no free place for this robot')
        return
    route = shortest_path(graph, start.id, goal.id)
    print(f'{len(graph.nodes)} nodes, {len(graph.edges)} edges')
    if route is None:
        print(f'no path from node {start.id} to node {goal.id}')
        return
    print(f'{route.cost_m:.1f} m over nodes {", ".join(map(str, route.node_ids))}')


if __name__ == '__main__':
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    for name in ('map', 'start', 'goal'):
        parser.add_argument(name)
    given = parser.parse_args()
    main(Path(given.map), given.start, given.goal)
