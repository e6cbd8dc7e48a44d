"""Compiles the kernels into their caches by a short drive, so that no node has to wait for that at its start."""

import numpy as np

from thinmap_ros.adapters import resources
from thinmap_ros.adapters.world_files import read_world
from thinmap_ros.core.exploration.explorer import Explorer, ExplorerConfig
from thinmap_ros.core.planning.navigator import Navigator, NavigatorConfig
from thinmap_ros.pipeline import Pipeline
from thinmap_ros.sim.coverage import coverable
from thinmap_ros.sim.lms200 import Lms200Config
from thinmap_ros.sim.pioneer import PRESETS
from thinmap_ros.sim.runner import Simulation
from thinmap_ros.sim.world import World

_STEPS = 100


def main() -> None:
    """Drive for a few seconds through everything that is compiled."""
    world = World.from_patch(*read_world(resources.world_path('room_10x10')))
    simulation = Simulation(world, world.start, PRESETS['2dx'], Lms200Config(), 0)
    pipeline, explorer, navigator = Pipeline(), Explorer(ExplorerConfig()), Navigator(NavigatorConfig())
    coverable(world, world.start, 0.3, 1.0)
    moment = simulation.sense()
    v, w = 0.1, 0.3
    for _ in range(_STEPS):
        if moment.scan is not None:
            T_map_base = pipeline.step(moment.scan, moment.T_odom_base).estimate.T_map_base
            patch = pipeline.grid.patch()
            decision = explorer.step(pipeline.topology.map, patch, moment.scan, T_map_base)
            if decision.target is not None:
                x, y, theta = (float(number) for number in decision.target.goal)
                navigator.set_goal(x, y, theta)
            command = navigator.step(T_map_base, patch, moment.scan, 0.1)
            v, w = (command.v, command.w) if np.isfinite([command.v, command.w]).all() else (v, w)
        moment = simulation.step(v, w)


if __name__ == '__main__':
    main()
