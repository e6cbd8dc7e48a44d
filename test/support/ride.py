"""A simulated robot that follows the commands of the navigator."""

import math

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.fields import distance_cells
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.grid.raytrace import cast_rays
from thinmap_ros.core.planning.navigator import Navigator, NavigatorConfig
from thinmap_ros.core.scan import Scan

DT = 0.1


def room(rows=60, cols=80):
    cells = np.zeros((rows, cols), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    return cells


class Ride:
    """A robot with exact motion in a world of cells, with a map that may be incomplete."""

    def __init__(self, world, start, known=None, config=None, noise=None):
        self.noise = noise
        self.world = world
        self.pose = np.array(start, dtype=np.float64)
        self.patch = GridPatch(GridFrame(0.0, 0.0, 0.1), world if known is None else known)
        self.navigator = Navigator(config or NavigatorConfig())
        self.nearest_m = math.inf
        self.commands = []
        self.seconds = 0.0

    def scan(self):
        angles = np.radians(np.arange(-90.0, 91.0))
        occupied = (self.world == 100).astype(np.uint8)
        ranges = (
            cast_rays(occupied, self.pose[0] / 0.1, self.pose[1] / 0.1, angles + self.pose[2], 80.0)
            * 0.1
        )
        if self.noise is not None:
            ranges = ranges + self.noise.normal(0.0, 0.01, ranges.shape)
        return Scan.create(int(self.seconds * 1e9), ranges, angles[0], np.radians(1.0), 0.02, 8.0)

    def step(self):
        command = self.navigator.step(self.pose, self.patch, self.scan(), DT)
        v = command.v
        w = command.w
        self.pose = se2.compose(
            self.pose,
            se2.pose(v * DT * math.cos(w * DT / 2), v * DT * math.sin(w * DT / 2), w * DT),
        )
        self.commands.append((v, w))
        self.seconds += DT
        clearance = (distance_cells(self.world == 100) - 0.5) * 0.1
        self.nearest_m = min(
            self.nearest_m, clearance[int(self.pose[1] / 0.1), int(self.pose[0] / 0.1)]
        )
        return command

    def go(self, goal, seconds=90.0):
        self.navigator.set_goal(*goal)
        states = []
        while self.seconds < seconds and (not states or states[-1].state in ('driving', 'blocked')):
            states.append(self.step())
        return states
