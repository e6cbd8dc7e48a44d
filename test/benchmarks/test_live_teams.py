"""What a live run of a team is judged by."""

import numpy as np

from benchmarks.team.live import count_ghosts
from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.sim.world import World

FRAME = GridFrame(0.0, 0.0, 0.05)
PATH = np.column_stack([np.linspace(1.0, 2.0, 21), np.full(21, 1.5)])


def room():
    """A closed room of 5 x 4 m."""
    cells = np.zeros((80, 100), dtype=np.uint8)
    cells[:2] = cells[-2:] = 1
    cells[:, :2] = cells[:, -2:] = 1
    return World('room', cells, FRAME, np.zeros(3))


def joint(cells):
    patch = GridPatch(FRAME, np.zeros((80, 100), dtype=np.int8))
    for row, col in cells:
        patch.cells[row, col] = 100
    return patch


def counted(cells, T=(0.0, 0.0, 0.0)):
    return count_ghosts(joint(cells), se2.pose(*T), room(), PATH)


def test_walls_of_the_world_are_no_ghosts_where_a_map_has_them_a_little_off():
    assert counted([(0, 50), (4, 50), (40, 2), (77, 30)]) == [0, 0]


def test_walls_that_the_world_has_not_are_ghosts_beside_a_path():
    assert counted([(30, 20), (35, 40), (60, 70)]) == [2, 3]


def test_the_map_is_laid_on_the_world():
    quarter = 0.5 * np.pi
    assert counted([(60, 30)], (4.6, 0.0, quarter)) == [1, 1]  # at 1.6 m, 1.5 m
