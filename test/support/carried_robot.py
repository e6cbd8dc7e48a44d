"""Scans and odometry of a kidnapped robot: its wheels notice nothing."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from support.driven_pieces import world_of

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.sim.drives import random_drive, random_start

PERIOD_NS = SECOND_NS // 5


class Moment(NamedTuple):
    """A scan, the odometry pose (3,) at it, the true pose (3,), and the number of the drive."""

    scan: Scan
    T_odom_base: np.ndarray
    T_world_base: np.ndarray
    drive: int


def start_of(building, drive):
    return random_start(world_of(building), np.random.default_rng([building, drive]))


def carried(*drives):
    """Yield the moments of some drives, each of a building, a number and a length, m."""
    T_odom = np.zeros(3)
    stamp_ns = 0
    for place, (building, drive, path_m) in enumerate(drives):
        before = None
        driven_m = 0.0
        for sample in random_drive(world_of(building), start_of(building, drive), drive):
            if before is not None:
                T_odom = se2.compose(T_odom, se2.between(before.T_odom_base, sample.T_odom_base))
                driven_m += float(np.hypot(*(sample.T_world_base - before.T_world_base)[:2]))
            before = sample
            stamp_ns += PERIOD_NS
            scan = replace(sample.scan, stamp_ns=stamp_ns)
            yield Moment(scan, T_odom, sample.T_world_base, place)
            if driven_m > path_m:
                break
