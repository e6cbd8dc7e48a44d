"""SLAM on a bag or a CARMEN log: trajectory, map and route graph.

Usage: python examples/slam_on_a_log.py bags/dead_end.mcap out/slam
Writes out/slam/map.pgm, map.yaml (for map_server), route.geojson (for Nav2's route server) and
final.tum, the pose of each scan.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path

from thinmap_ros import Pipeline, open_log, paired_scans, write_graph, write_map, write_trajectory


def main(log: str, folder: Path) -> None:
    """Run SLAM on a log and write the results into a folder."""
    slam = Pipeline()
    for scan, T_odom_base in paired_scans(open_log(log)):
        slam.step(scan, T_odom_base)
    slam.finish()
    folder.mkdir(parents=True, exist_ok=True)
    write_map(folder / 'map', slam.grid.known_area())
    write_graph(folder / 'route.geojson', slam.topology.map)
    write_trajectory(folder / 'final.tum', slam.trajectory.final)
    print(slam.trajectory.final)
    print(slam.topology.map)


if __name__ == '__main__':
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument('log')
    parser.add_argument('folder', type=Path)
    given = parser.parse_args()
    main(given.log, given.folder)
