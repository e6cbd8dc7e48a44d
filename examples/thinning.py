"""The free space of a small map, and its skeleton by the thinning of Zhang and Suen.

Usage: python examples/thinning.py
Prints occupied cells as #, the skeleton as o, other free cells as dots.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter

import numpy as np

from thinmap_ros import thin

ROOMS = """
########################
#..........#...........#
#..........#...........#
#......................#
#..........#...........#
#..........#...........#
######..################
#......................#
#......................#
########################
"""


def main() -> None:
    """Print the skeleton on the map."""
    cells = np.array([list(line) for line in ROOMS.split()])
    skeleton = thin(cells == '.')
    for line in np.where(skeleton, 'o', cells):
        print(''.join(line))


if __name__ == '__main__':
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.parse_args()
    main()
