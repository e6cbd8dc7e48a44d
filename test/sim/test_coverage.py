"""Coverage compared with a slow reference that follows the definition."""

from collections import deque
from dataclasses import replace

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.sim.coverage import observable_cells, robot_observable_cells
from thinmap_ros.sim.moving_obstacles import Doors, MovingObstacles, Pedestrians
from thinmap_ros.sim.robot import RobotConfig
from thinmap_ros.sim.world import World


def walled(
    rows: int, cols: int, origin: tuple[float, float] = (0.0, 0.0), seed: int | None = None
) -> World:
    cells = np.zeros((rows, cols), dtype=np.uint8)
    if seed is not None:
        rng = np.random.default_rng(seed)
        for _ in range(9):
            r = rng.integers(0, rows)
            c = rng.integers(0, cols)
            h = rng.integers(1, 12)
            w = rng.integers(1, 12)
            cells[r : r + h, c : c + w] = 1
        cells[rows // 2 - 4 : rows // 2 + 5, cols // 2 - 4 : cols // 2 + 5] = 0
    cells[0] = 1
    cells[-1] = 1
    cells[:, 0] = 1
    cells[:, -1] = 1
    return World('test', cells, GridFrame(*origin, 0.1), np.zeros(3))


def reference(
    world: World, start_cell: tuple[int, int], radius_m: float, range_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Free cells certainly and possibly visible: fine rays from reachable cells, then one more."""
    solid = world.occupied != 0
    standing = world.distance_to_wall_m > radius_m
    reached = np.zeros_like(standing)
    todo = deque([start_cell])
    while todo:
        r, c = todo.popleft()
        if standing[r, c] and not reached[r, c]:
            reached[r, c] = True
            todo.extend([(r + 1, c), (r - 1, c), (r, c + 1), (r, c - 1)])
    seen = np.zeros_like(solid)
    perhaps = np.zeros_like(solid)
    from thinmap_ros.core.grid.raytrace import line_is_clear

    places = np.argwhere(reached)
    for r, c in np.argwhere(~solid):
        away = np.hypot(places[:, 0] - r, places[:, 1] - c) * 0.1
        for p in places[np.argsort(away)][: int((away <= range_m).sum())]:
            if line_is_clear(~solid, int(r), int(c), int(p[0]), int(p[1])):
                seen[r, c] = True
                break
        perhaps[r, c] = away.min() <= range_m + 0.1
    return seen, perhaps & ~solid


@pytest.mark.parametrize('seed', range(6))
def test_it_is_the_definition(seed: int) -> None:
    world = walled(50, 60, seed=seed)
    start = np.array([3.05, 2.55, 0.0])
    ours = observable_cells(world, start, 0.25, 3.0).cells
    seen, perhaps = reference(world, (25, 30), 0.25, 3.0)
    assert not (ours & ~perhaps).any()
    # Centre to centre, a line may pass between two solid cells that touch at a corner; no ray of
    # ours does.
    assert (seen & ~ours).sum() <= 0.001 * seen.sum()
    # Here a cell is visible if a ray hits any part of it, there if it hits its centre.
    assert (ours & ~seen).sum() <= 0.02 * seen.sum()


def test_a_closet_that_the_robot_cannot_enter_is_seen_through_its_door() -> None:
    world = walled(40, 40)
    world.occupied[20, :] = 1
    world.occupied[20, 18:21] = 0  # 0.3 m wide
    inside = observable_cells(world, np.array([1.95, 1.0, 0.0]), 0.25, 8.0)
    assert inside.cells[1:20, 1:39].all()
    assert inside.cells[21:39, 19].all()
    assert not inside.cells[21, 2]
    world.occupied[20, 18:21] = 1
    assert not observable_cells(world, np.array([1.95, 1.0, 0.0]), 0.25, 8.0).cells[21:].any()


def with_door(period_s: float, open_rad: float, shut: bool = False) -> tuple[World, np.ndarray]:
    """Two rooms of 2 x 4 m, a doorway of 0.9 m, and a leaf that opens into the first one."""
    world = walled(40, 40)
    world.occupied[20, :] = 1
    world.occupied[20, 15:24] = 0
    doors = Doors(
        np.array([[1.5, 2.05]]),
        np.array([[2.4, 2.05]]),
        np.array([period_s]),
        np.array([[-open_rad]]),
        np.array([[shut]]),
    )
    nobody = Pedestrians(np.zeros((0, 4, 2)), np.zeros(0), np.zeros((0, 4)))
    return replace(world, moving=MovingObstacles(nobody, doors)), np.array([0.6, 0.6, 0.0])


def test_a_door_leaf_that_never_moves_is_an_obstacle_that_moves_is_none() -> None:
    without = observable_cells(*with_door(10.0, 0.3), 0.25, 8.0).cells
    assert without[21:39, 1:39].all(), 'a robot waits for a door'
    assert (observable_cells(*with_door(np.inf, 0.3, True), 0.25, 8.0).cells == without).all()
    ajar = observable_cells(*with_door(np.inf, 0.3), 0.25, 8.0).cells
    assert not ajar[21:39, 1:39].all(), 'too narrow for the robot: what it cannot see is not asked'
    wide = observable_cells(*with_door(np.inf, 1.5), 0.25, 8.0).cells
    assert wide[21:39, 1:39].all()
    leaf = without & ~wide
    rows, cols = np.nonzero(leaf)
    assert 8 <= leaf.sum() <= 20
    assert rows.min() >= 11 and cols.min() >= 14 and cols.max() <= 17


def test_a_leaf_at_the_start_is_no_obstacle() -> None:
    world, _ = with_door(np.inf, 1.5)
    at_the_leaf = np.array([1.75, 1.6, 0.0])
    found = observable_cells(world, at_the_leaf, 0.25, 8.0).cells
    assert (found == observable_cells(*with_door(10.0, 1.5), 0.25, 8.0).cells).all()


def test_a_robot_is_asked_to_see_what_it_plans_to_enter_or_starts_in() -> None:
    robot = RobotConfig(radius_m=0.2)
    world = walled(40, 40)
    world.occupied[20, :] = 1
    world.occupied[20, 18:23] = 0  # 0.5 m wide: paths are planned for a radius of 0.25 m
    south = np.array([2.0, 1.0, 0.0])
    found = robot_observable_cells(world, south, robot, 8.0)
    assert (found.cells == observable_cells(world, south, 0.25, 8.0).cells).all()
    assert not found.cells[21:39, 1:39].all()
    narrow = np.array([2.05, 2.05, 0.0])
    assert robot_observable_cells(world, narrow, robot, 8.0).cells[1:20, 1:39].all()


def test_range_counts() -> None:
    world = walled(10, 100)
    world.occupied[1:6, 30:99] = 1  # the rest is a slit of 0.3 m
    world.occupied[8, 30:99] = 1
    short, long = (
        observable_cells(world, np.array([1.0, 0.5, 0.0]), 0.2, r).cells[6:8].any(axis=0)
        for r in (2.0, 5.0)
    )
    reached = 28
    assert short[reached] and long[reached]
    assert 1.5 < 0.1 * (np.flatnonzero(short).max() - reached) <= 2.1
    assert 4.5 < 0.1 * (np.flatnonzero(long).max() - reached) <= 5.1


def test_the_lattice_is_that_of_maps() -> None:
    fine = np.zeros((300, 300), dtype=np.uint8)
    fine[10:15, 10:290] = 1
    fine[285:290, 10:290] = 1
    fine[10:290, 10:15] = 1
    fine[10:290, 285:290] = 1
    world = World('fine', fine, GridFrame(-0.26, -0.26, 0.02), np.zeros(3))
    found = observable_cells(world, np.array([1.0, 1.0, 0.0]), 0.2, 8.0)
    np.testing.assert_allclose(found.frame.as_array(), [-0.3, -0.3, 0.1])
    # Inner walls at 0.04 and 5.44: whole cells without wall from 0.1 to 5.4.
    assert found.area_m2 == pytest.approx(5.3**2)


def patch_of(cells: np.ndarray, frame: GridFrame, free: np.ndarray) -> GridPatch:
    return GridPatch(frame, np.where(free, np.int8(0), np.int8(UNKNOWN)))


def test_share_known() -> None:
    world = walled(40, 50)
    found = observable_cells(world, np.array([2.0, 2.0, 0.0]), 0.2, 8.0)
    everything = GridPatch(GridFrame(-5.0, -5.0, 0.1), np.zeros((200, 200), dtype=np.int8))
    assert found.coverage(everything) == 1.0
    nothing = GridPatch(everything.frame, np.full((200, 200), UNKNOWN, dtype=np.int8))
    assert found.coverage(nothing) == 0.0
    half = nothing.cells.copy()
    half[:, : 50 + 25] = 0  # x < 2.5
    assert found.coverage(GridPatch(everything.frame, half)) == pytest.approx(24 / 48)
    small = GridPatch(GridFrame(0.1, 0.1, 0.1), np.zeros((19, 48), dtype=np.int8))
    assert found.coverage(small) == pytest.approx(19 / 38)


def test_share_known_of_a_map_in_a_frame_of_its_own() -> None:
    world = walled(40, 50)
    found = observable_cells(world, np.array([2.0, 2.0, 0.0]), 0.2, 8.0)
    T_world_map = np.array([2.0, 2.0, np.pi / 2])
    # x from -2 to 0 in the map is y from 0 to 2 in the world.
    lower = GridPatch(GridFrame(-2.0, -3.0, 0.1), np.zeros((60, 20), dtype=np.int8))
    assert found.coverage(lower, T_world_map) == pytest.approx(19 / 38, abs=0.03)
    assert found.coverage(lower, T_world_map) == found.coverage(
        lower, T_world_map + se2.pose(0, 0, 0)
    )


def test_a_start_where_the_robot_does_not_fit() -> None:
    with pytest.raises(InputError, match='does not fit'):
        observable_cells(walled(20, 20), np.array([0.2, 1.0, 0.0]), 0.25, 8.0)
