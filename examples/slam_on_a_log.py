"""SLAM on a bag or a CARMEN log: trajectory length, map and route graph.

Usage: python examples/slam_on_a_log.py bags/dead_end.mcap out/slam
Writes out/slam/map.pgm, map.yaml (for map_server) and route.geojson (for Nav2's route server).
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path

import numpy as np

from thinmap_ros import Pipeline, open_log, paired_scans, write_graph, write_map


def main(log: str, folder: Path) -> None:
    """Run SLAM on a log and write the results into a folder."""
    slam = Pipeline()
    positions = []
    for scan, T_odom_base in paired_scans(open_log(log)):
        estimate = slam.step(scan, T_odom_base).estimate
        positions.append(estimate.T_map_base[:2])
    slam.finish()
    folder.mkdir(parents=True, exist_ok=True)
    write_map(folder / 'map', slam.grid.known_area())
    write_graph(folder / 'route.geojson', slam.topology.map)
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    print(f'{len(positions)} scans, {steps_m.sum():.1f} m, {len(slam.topology.map.nodes)} nodes')


if __name__ == '__main__':
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument('log')
    parser.add_argument('folder', type=Path)
    given = parser.parse_args()
    main(given.log, given.folder)
