"""Compiles all kernels into their caches, so that no node has to wait for that at its start."""

from thinmap_ros import warm_up
from thinmap_ros.adapters import resources
from thinmap_ros.adapters.world_files import read_world
from thinmap_ros.sim.coverage import coverable
from thinmap_ros.sim.lms200 import Lms200Config
from thinmap_ros.sim.pioneer import PRESETS
from thinmap_ros.sim.runner import Simulation
from thinmap_ros.sim.world import World


def main() -> None:
    """Rehearse every algorithm, and the simulation."""
    for rehearse in (
        warm_up.localizer, warm_up.grid_mapper, warm_up.topology_builder, warm_up.explorer, warm_up.navigator,
        warm_up.global_localizer,
    ):  # fmt: skip
        rehearse()
    world = World.from_patch(*read_world(resources.world_path('room_10x10')))
    coverable(world, world.start, 0.3, 1.0)
    Simulation(world, world.start, PRESETS['2dx'], Lms200Config(), 0).sense()


if __name__ == '__main__':
    main()
