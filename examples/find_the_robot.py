"""Global localization: a robot with a finished map finds out where it is while it drives.

Usage: python examples/find_the_robot.py WORLD BAG
As in: python examples/find_the_robot.py office bags/office.mcap
WORLD: a world or map_server YAML, or the name of a world of the package.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter

from thinmap_ros import (
    GlobalLocalizer,
    TopologyConfig,
    build_topology,
    open_log,
    paired_scans,
    read_world,
    world_path,
)


def main(world: str, bag: str) -> None:
    """Print the pose of the robot as soon as it is the only one that explains the scans."""
    _, patch, _ = read_world(world_path(world))
    localizer = GlobalLocalizer(patch, build_topology(patch, None, TopologyConfig()))
    for scans, (scan, T_odom_base) in enumerate(paired_scans(open_log(bag)), start=1):
        found = localizer.step(scan, T_odom_base).pose
        if found is not None:
            x, y, yaw = found.T_map_base
            print(f'after {scans} scans: x {x:.2f} m, y {y:.2f} m, heading {yaw:.2f} rad')
            return
    print(f'not certain after {scans} scans')


if __name__ == '__main__':
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument('world')
    parser.add_argument('bag')
    main(**vars(parser.parse_args()))
