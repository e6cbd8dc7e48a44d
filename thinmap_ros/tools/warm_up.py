"""Compiles all kernels and caches them, so that programs start without compilation."""

import argparse
import gc

from thinmap_ros import kernels
from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.evaluation.exploration_run import explore
from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.jit import cache
from thinmap_ros.sim.world import World
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser


def main() -> None:
    """Run the command line."""
    parser = Parser('warm_up', __doc__)
    parser.add_argument(
        '--for-all-users',
        action='store_true',
        help='also leave them in the package, for other users of this install',
    )
    cli.run(work, parser)


def work(arguments: argparse.Namespace) -> None:
    """Run every algorithm once, and an exploration in the simulator."""
    # Compilers make many objects and few cycles: looking for these takes a seventh of the time.
    gc.disable()
    for rehearse in kernels.ALL:
        rehearse()
    world = World.from_patch(*read_world(package_data.world_path('office')))
    # A complete exploration reaches the kernels that need several targets.
    explore(world, world.start, Options(localization='slam'))
    kept = cache.leave_beside_package() if arguments.for_all_users else cache.folder()
    print(
        f'all kernels are compiled, and cached in {kept}' if kept else 'there is no folder for them'
    )


if __name__ == '__main__':
    main()
