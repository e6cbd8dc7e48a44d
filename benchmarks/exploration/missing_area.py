"""What explorations of buildings do not see, and what they tell that they do not.

Usage: python -m benchmarks.exploration.missing_area [--seed N] [--buildings N]. Prints a row for
each building, and how many free cells there are for each frontier cell: a constant of belief.py.
"""

import argparse
from typing import NamedTuple

import numpy as np

from benchmarks.exploration.observed_candidates import generated, known_free_cells, load_case
from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.core.exploration.belief import MissingArea
from thinmap_ros.evaluation.exploration_run import explore
from thinmap_ros.sim.coverage import robot_observable_cells
from thinmap_ros.sim.robot import PRESETS

_SPEED_M_S = 0.5


class Missed(NamedTuple):
    """Observable free cells that the map shows as unknown at the end of an exploration.

    Those that it shows as occupied were seen: a wall covers a part of a cell. frontiers: its
    frontier cells; told: m2.
    """

    cells: int
    frontiers: int
    told: MissingArea
    cell_m2: float


def missed(name: str) -> Missed:
    """What an exploration of a case does not see."""
    world, start = load_case(name)
    options = Options(speed_m_s=_SPEED_M_S)
    robot, _ = explore(world, start, options)
    preset = PRESETS[options.robot]
    observable = robot_observable_cells(world, start, preset, options.laser.range_max_m)
    patch = robot.pipeline.grid.known_area()
    unseen = np.argwhere(observable.cells & ~known_free_cells(patch, observable))
    decision = robot.mission.decision
    assert decision is not None and decision.missing is not None
    frontiers = robot.explorer.frontier_map
    at = frontiers.frame.cells_of(observable.frame.centres_of(unseen))
    is_there = ((at >= 0) & (at < frontiers.free.shape)).all(axis=1)
    occupied = ~frontiers.passable[tuple(at[is_there].T)]
    return Missed(
        len(unseen) - int(np.count_nonzero(occupied)),
        int(np.count_nonzero(frontiers.mask)),
        decision.missing,
        observable.frame.resolution**2,
    )


def fringe(found: list[Missed]) -> float:
    """Unseen cells for each frontier cell; a median: now and then one hides a part of a room."""
    return float(np.median([one.cells / max(one.frontiers, 1) for one in found]))


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seed', type=int, default=5000, help='of the first building')
    parser.add_argument('--buildings', type=int, default=20)
    arguments = parser.parse_args()
    found = []
    for name in generated(arguments.seed, arguments.buildings):
        one = missed(name)
        found.append(one)
        true_m2 = one.cells * one.cell_m2
        told = f'expected {one.told.expected_m2:.2f}, bound {one.told.bound_m2:.2f}'
        print(f'{name}: {true_m2:.2f} m2; {told}', flush=True)
    errors = [abs(one.told.expected_m2 - one.cells * one.cell_m2) for one in found]
    held = sum(one.told.bound_m2 >= one.cells * one.cell_m2 for one in found)
    print(f'mean error {np.mean(errors):.2f} m2; bound holds in {held} of {len(found)}')
    print(f'{fringe(found):.2f} cells for each frontier cell')


if __name__ == '__main__':
    main()
