"""Buildings from seeds: reachability, glass, moving people and swinging doors."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.buildings import BuildingConfig, generate_building
from benchmarks.floor_plan import FloorPlanConfig, Kind, generate_floor_plan
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig
from thinmap_ros.sim.moving_obstacles import Doors, MovingObstacles, Pedestrians
from thinmap_ros.sim.robot import RobotConfig
from thinmap_ros.sim.world import World, inside_of

SEEDS = range(24)
EXACT = LaserScannerConfig(range_noise_m=0.0, range_resolution_m=0.0, mixed_pixel_ratio=0.0)
NOBODY = Pedestrians(np.zeros((0, 4, 2)), np.zeros(0), np.zeros((0, 4)))
NO_DOOR = Doors(
    np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 1)), np.zeros((0, 1), bool)
)


def plain(seed, **given):
    """A building without furniture."""
    return generate_building(seed, BuildingConfig(clutter=0.0, **given))


@pytest.mark.parametrize('seed', SEEDS)
def test_a_robot_gets_into_every_part(seed):
    made = plain(seed, area_m2=600.0 + 100.0 * seed)
    world = made.world
    inside = inside_of(replace(world, occupied=(world.distance_to_wall_m < 0.3).astype(np.uint8)))
    assert world.is_clear(*world.start[:2], RobotConfig().radius_m)
    for wing in made.wings:
        for part in wing.plan.parts:
            middle = np.array([[0.5 * (part.x0 + part.x1), 0.5 * (part.y0 + part.y1)]])
            x, y, turn = wing.T_world_wing
            c = math.cos(turn)
            s = math.sin(turn)
            at = world.frame.cells_of(middle @ np.array([[c, s], [-s, c]]) + (x, y))[0]
            near = inside[at[0] - 12 : at[0] + 13, at[1] - 12 : at[1] + 13]
            assert near.any(), part


def test_parts_tile_the_plan():
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        plan = generate_floor_plan(*rng.uniform(10.0, 120.0, 2), FloorPlanConfig(0.3), rng)
        area = sum(part.width * part.depth for part in plan.parts)
        assert area == pytest.approx(plan.width * plan.depth)
        assert min(min(part.width, part.depth) for part in plan.parts) > 1.5
        assert all(door.length > 0.8 for door in plan.doors)


def test_a_seed_says_all_and_another_says_something_else():
    one = generate_building(5)
    same = generate_building(5)
    other = generate_building(6)
    assert np.array_equal(one.world.occupied, same.world.occupied)
    assert one.world.frame == same.world.frame
    assert np.array_equal(one.world.start, same.world.start)
    places = [made.world.moving.pedestrians.places(77.0) for made in (one, same)]
    assert np.array_equal(*places)
    leaves = [vars(made.world.moving.doors) for made in (one, same)]
    assert all(np.array_equal(leaves[0][name], leaves[1][name]) for name in leaves[0])
    assert one.world.occupied.shape != other.world.occupied.shape


def test_what_is_asked_for():
    made = plain(3, area_m2=4000.0, hall_share=0.0, wings=1, people_per_1000_m2=0.0)
    assert made.area_m2 == pytest.approx(4000.0, rel=0.1)
    assert len(made.wings) == 1
    assert not any(part.kind is Kind.HALL for part in made.wings[0].plan.parts)
    assert made.world.moving is None or len(made.world.moving.pedestrians.points) == 0
    halls = plain(3, area_m2=4000.0, hall_share=1.0)
    wide = [p for w in halls.wings for p in w.plan.parts if p.kind is Kind.HALL]
    assert any(min(hall.width, hall.depth) > 16.0 for hall in wide)  # wider than 8 m of laser


def test_oblique_wings_are_among_them():
    made = [plain(seed, area_m2=2000.0, wings=3) for seed in SEEDS]
    turns = [wing.T_world_wing[2] % (0.5 * math.pi) for each in made for wing in each.wings]
    oblique = [turn for turn in turns if 0.05 < turn < 0.5 * math.pi - 0.05]
    assert len(turns) > 2 * len(SEEDS)
    assert len(oblique) > len(SEEDS) // 2


def test_the_largest():
    made = generate_building(1, BuildingConfig(area_m2=100_000.0))
    assert made.area_m2 > 50_000.0
    assert made.world.is_clear(*made.world.start[:2], RobotConfig().radius_m)


@pytest.mark.parametrize('area_m2', [math.nan, 0.0, 100.0, 1e6])
def test_a_size_that_there_is_not_is_refused(area_m2):
    with pytest.raises(InputError, match=r'area_m2: .*: expected 150 to 100000 m2'):
        generate_building(0, BuildingConfig(area_m2=area_m2))


def walled(glass, moving=None):
    """A room with its right wall at x = 3 m, seen from (1, 2)."""
    occupied = np.zeros((80, 80), dtype=np.uint8)
    occupied[:, 60:62] = 1
    pane = np.zeros_like(occupied, dtype=bool)
    pane[35:45, 60:62] = glass
    return World('room', occupied, GridFrame(0.0, 0.0, 0.05), np.zeros(3), pane, moving)


def ahead(world, seconds=0.0):
    """Range of the beam straight ahead, along x from (1, 2)."""
    scan = LaserScanner(EXACT, 0).scan(world, np.array([1.0, 2.0, 0.0]), round(1e9 * seconds))
    return scan.ranges_m[90]


def test_glass_returns_nothing_and_is_solid():
    assert ahead(walled(glass=False)) == pytest.approx(2.0)
    assert ahead(walled(glass=True)) == math.inf
    assert not walled(glass=True).is_clear(3.0, 2.0, 0.2)


def test_people_are_seen_where_they_are_then_and_step_aside():
    points = np.array([[[2.0, 2.0], [2.0, 3.9], [2.0, 3.9], [2.0, 2.0]]])
    people = Pedestrians(points, np.array([1.0]), np.full((1, 4), 10.0))
    world = walled(False, MovingObstacles(people, NO_DOOR))
    assert ahead(world, 5.0) == pytest.approx(0.8)
    assert people.places(11.0)[0] == pytest.approx((2.0, 3.0))
    assert ahead(world, 20.0) == pytest.approx(2.0)
    assert ahead(world, 43.8 + 5.0) == pytest.approx(0.8)  # round again
    beside = Pedestrians(points - (0.6, 0.0), np.array([1.0]), np.full((1, 4), 10.0))
    assert ahead(walled(False, MovingObstacles(beside, NO_DOOR)), 5.0) == pytest.approx(2.0)


def test_people_walk_evenly_from_point_to_point():
    rng = np.random.default_rng(2)
    points = rng.uniform(0.0, 20.0, (6, 4, 2))
    speeds = rng.uniform(0.5, 1.4, 6)
    points[3, 2] = points[3, 1]
    pauses = rng.exponential(8.0, (6, 4))
    pauses[4] = 0.0
    people = Pedestrians(points, speeds, pauses)
    for seconds in (0.0, *rng.uniform(0.0, 500.0, 200)):
        for i, place in enumerate(people.places(seconds)):
            times = [0.0]
            stations = [points[i, 0]]
            for k, pause in enumerate(pauses[i]):
                goal = points[i, (k + 1) % 4]
                leg = np.hypot(*(goal - points[i, k])) / speeds[i]
                times += [times[-1] + pause, times[-1] + pause + leg]
                stations += [points[i, k], goal]
            now = seconds % times[-1]
            wanted = [np.interp(now, times, axis) for axis in np.transpose(stations)]
            assert place == pytest.approx(wanted, abs=1e-9)


def test_doors_swing_and_are_held_open_for_a_robot():
    hinges = np.array([[2.0, 1.5]])
    ends = np.array([[2.0, 2.5]])
    open_rad = np.array([[1.0, -0.5, 1.0]])
    is_shut = np.array([[False, False, True]])
    leaves = Doors(hinges, ends, np.array([10.0]), open_rad, is_shut)
    far = np.array([-6.0, 2.0])
    near = np.array([1.0, 2.0])

    def angle(seconds, robot):
        leaf = leaves.segments(seconds, robot, 20.0)[0]
        assert np.hypot(*(leaf[2:] - leaf[:2])) == pytest.approx(1.0)
        return math.atan2(leaf[3] - leaf[1], leaf[2] - leaf[0]) - 0.5 * math.pi

    for first in (0.0, 30.0, 3000.0):  # round again
        seen = [angle(first + seconds, far) for seconds in (0.0, 9.9, 10.0, 20.0, 29.9)]
        assert seen == pytest.approx([1.0, 1.0, -0.5, 0.0, 0.0])
    assert [angle(seconds, near) for seconds in (10.0, 20.0)] == pytest.approx([-0.5, 1.0])
    blocked = Doors(hinges, ends, np.array([np.inf]), np.ones((1, 2)), np.array([[True, False]]))
    world = walled(False, MovingObstacles(NOBODY, blocked))
    for seconds in (0.0, 1e4):
        scan = LaserScanner(EXACT, 0).scan(world, np.array([-1.5, 2.0, 0.0]), round(1e9 * seconds))
        assert scan.ranges_m[90] == pytest.approx(3.5)


def test_doors_that_move_are_shut_half_of_the_time():
    for share in (0.0, 0.5, 1.0):
        leaves = plain(3, area_m2=4000.0, moving_doors=share).world.moving.doors
        moves = np.isfinite(leaves.period_s)
        assert moves.mean() == pytest.approx(share, abs=0.2)
        assert not leaves.is_shut[~moves].any()
        assert share == 0.0 or leaves.is_shut[moves].mean() == pytest.approx(0.5, abs=0.1)
        assert (leaves.open_rad > 0.0).any() and (leaves.open_rad < 0.0).any()
        assert np.abs(leaves.open_rad).min() >= 0.6
