"""Compiles all kernels into their caches, so that no node has to wait for that at its start."""

from thinmap_ros import warm_up
from thinmap_ros.adapters import resources
from thinmap_ros.adapters.world_files import read_world
from thinmap_ros.sim.world import World
from thinmap_ros.tools import explore_world


def main() -> None:
    """Rehearse every algorithm, and an exploration in the simulator."""
    for rehearse in (
        warm_up.localizer,
        warm_up.grid_mapper,
        warm_up.topology_builder,
        warm_up.explorer,
        warm_up.navigator,
        warm_up.global_localizer,
    ):
        rehearse()
    world = World.from_patch(*read_world(resources.world_path('office')))
    # What is needed only where there are several places to go to is reached by a whole exploration.
    explore_world.explore(world, world.start, explore_world.Options(localization='slam'))


if __name__ == '__main__':
    main()
