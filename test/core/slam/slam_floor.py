"""A floor with a corridor and rooms on both sides, and a robot that visits one after the other."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.slam.localizer import Localizer, LocalizerConfig
from thinmap_ros.sim.lms200 import Lms200Config
from thinmap_ros.sim.pioneer import PioneerConfig
from thinmap_ros.sim.runner import Simulation
from thinmap_ros.sim.world import World

SPEED, TURN = 0.2, 0.5
CORRIDOR_Y, DOOR_M = (4.2, 6.0), 1.1


def floor_world(folder: Path, length_m: float, room_m: float) -> World:
    """A floor of a length and 10 m, rooms of a width along both sides."""
    walls = [[[0, 0], [length_m, 0], [length_m, 10], [0, 10], [0, 0]]]
    for x in np.arange(0.0, length_m, room_m).tolist():
        door = x + 0.5 * (room_m - DOOR_M)
        for y, outer in zip(CORRIDOR_Y, (0.0, 10.0), strict=True):
            walls += [[[x, y], [door, y]], [[door + DOOR_M, y], [x + room_m, y]]]
            walls += [[[x, outer], [x, y]]] if x > 0.0 else []
    text = f'name: floor\nresolution: 0.05\nwall_thickness: 0.1\nstart: [1.0, 5.1, 0.0]\nwalls: {walls}\n'
    path = folder / 'floor.yaml'
    path.write_text(text)
    return World.load(path)


def round_of_rooms(length_m: float, room_m: float) -> list[tuple[float, float]]:
    """Places to visit: into each room and out again, along the corridor, and back to the start."""
    places = []
    for x in np.arange(0.5 * room_m, length_m, room_m).tolist():
        places += [(x, 5.1), (x, 2.2), (x, 5.1), (x, 7.8), (x, 5.1)]
    return [*places, (1.0, 5.1)]


def driven(
    world: World, places: list[tuple[float, float]], seed: int, seconds: float
) -> Iterator[tuple[np.ndarray, Scan, np.ndarray]]:
    """True pose, scan and odometry pose at each scan; the robot is steered by its true pose."""
    simulation = Simulation(world, world.start, PioneerConfig(), Lms200Config(), seed)
    moment, goals = simulation.sense(), iter(places)
    goal = next(goals)
    while moment.stamp_ns < seconds * 1e9:
        truth = simulation.robot.T_world_base
        if moment.scan is not None:
            yield truth, moment.scan, moment.T_odom_base
        off = np.array(goal) - truth[:2]
        if np.hypot(*off) < 0.15:
            goal = next(goals, None)
            if goal is None:
                return
            continue
        turn = se2.wrap(math.atan2(off[1], off[0]) - float(truth[2]))
        moment = simulation.step(SPEED if abs(turn) < 0.3 else 0.0, float(np.clip(2.0 * turn, -TURN, TURN)))


def localized(
    rows: Iterator[tuple[np.ndarray, Scan, np.ndarray]], **config: object
) -> tuple[np.ndarray, np.ndarray, Localizer]:
    """True and estimated poses (N, 3) of a drive, and the localizer."""
    localizer, truths, poses = None, [], []
    for truth, scan, odom in rows:
        if localizer is None:
            start = {'start_x_m': truth[0], 'start_y_m': truth[1], 'start_yaw_rad': truth[2]}
            localizer = Localizer(LocalizerConfig(**{**start, **config}))
        truths.append(truth)
        poses.append(localizer.step(scan, odom).T_map_base)
    return np.array(truths), np.array(poses), localizer


def errors_of(truths: np.ndarray, poses: np.ndarray) -> tuple[float, float, float, float]:
    """RMSE (m, degrees) and largest error (m, degrees)."""
    off = np.hypot(*(poses - truths)[:, :2].T)
    turned = np.degrees(np.abs(se2.wrap(poses[:, 2] - truths[:, 2])))
    rmse = np.sqrt(np.mean(off**2)), np.sqrt(np.mean(turned**2))
    return float(rmse[0]), float(rmse[1]), float(off.max()), float(turned.max())
