"""The papers' worlds.

With the sizes and numbers of lines in the papers, and tours that a robot can drive.
"""

from pathlib import Path

import numpy as np
import pytest

from scripts.make_warehouse import warehouse_yaml
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.raytrace import cast_rays
from thinmap_ros.files.worlds import read_tour, read_world
from thinmap_ros.sim.drives import DriveConfig, drive, tour_paths
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.simulation import Simulation
from thinmap_ros.sim.world import World, surfaces

WORLDS = Path(__file__).parents[2] / 'worlds'
SHORTEST_M = 0.8
RANGE_M = 8.0
LONG_TOURS = ['office', 'floor_40x10', 'floor_70x10', 'dead_end', 'joined_hallways', 'lab']


def load(name: str) -> tuple[World, np.ndarray]:
    path = WORLDS / f'{name}.yaml'
    return World.from_patch(*read_world(path)), read_tour(path)


@pytest.mark.parametrize(
    ('name', 'size', 'lines'),
    [
        ('office', (9.5, 7.5), 23),
        ('floor_40x10', (40.0, 10.0), 33),
        ('floor_70x10', (70.0, 10.0), 88),
        ('room_10x10', (10.0, 10.0), 20),
        ('lab', (20.0, 10.0), 49),
    ],
)
def test_size_and_lines_are_the_papers(name: str, size: tuple[float, float], lines: int) -> None:
    world, _ = load(name)
    found = surfaces(world, SHORTEST_M)
    assert len(found) == lines
    # The outer walls are centred on the boundary, half their thickness inside.
    span = np.ptp(found.reshape(-1, 2), axis=0)
    assert span == pytest.approx(np.array(size) - 0.1, abs=0.05)


def test_surfaces_of_a_box_in_a_room() -> None:
    cells = np.ones((40, 60), dtype=np.uint8)
    cells[5:35, 5:55] = 0
    cells[15:20, 20:40] = 1
    cells[0:3, 0:3] = 0  # outside: not visible
    world = World('box', cells, load('office')[0].frame, np.zeros(3))
    frame = world.frame
    start = frame.centres_of(np.array([[10, 10]]))[0]
    world = World('box', cells, frame, np.array([*start, 0.0]))
    found = surfaces(world, 0.2)
    lengths = np.hypot(*(found[:, 2:] - found[:, :2]).T) / frame.resolution
    assert sorted(np.round(lengths).astype(int).tolist()) == [20, 20, 30, 30, 50, 50]
    assert len(surfaces(world, 0.1)) == 8
    assert len(surfaces(world, 0.09)) == 8


@pytest.mark.parametrize('name', ['office', 'floor_40x10', 'floor_70x10'])
def test_every_line_is_in_sight_of_the_tour(name: str) -> None:
    world, tour = load(name)
    legs = zip(np.vstack([world.start[:2], tour[:-1]]), tour, strict=True)
    places = np.vstack([a + np.linspace(0.0, 1.0, 20)[:, None] * (b - a) for a, b in legs])
    resolution = world.frame.resolution
    for face in surfaces(world, SHORTEST_M):
        assert any(_sees(world, place, face, resolution) for place in places), face


def _sees(world: World, place: np.ndarray, face: np.ndarray, resolution: float) -> bool:
    """Whether a beam from a position to the centre of a face reaches the face."""
    off = 0.5 * (face[:2] + face[2:]) - place
    distance = float(np.hypot(*off))
    if distance > RANGE_M:
        return False
    x, y = (place - (world.frame.origin_x, world.frame.origin_y)) / resolution
    angle = np.array([np.arctan2(off[1], off[0])])
    reach = cast_rays(world.occupied, x, y, angle, RANGE_M / resolution)[0] * resolution
    return bool(reach > distance - 2 * resolution)


@pytest.mark.parametrize('name', LONG_TOURS)
def test_the_tour_can_be_driven(name: str) -> None:
    world, tour = load(name)
    robot = PRESETS['2dx']
    simulation = Simulation(world, world.start, robot, LaserScannerConfig(scan_rate_hz=0.1), 0)
    poses = np.array(
        [
            sample.T_world_base
            for sample in drive(
                simulation, tour_paths(world, tour, robot.radius_m), DriveConfig(0.5)
            )
        ]
    )
    assert simulation.robot.collisions == 0
    assert np.hypot(*(simulation.robot.T_world_base[:2] - tour[-1])) < 0.31
    assert len(poses) > 1


@pytest.mark.parametrize('name', ['office', 'floor_40x10', 'floor_70x10', 'warehouse'])
def test_the_tour_is_closed(name: str) -> None:
    path = WORLDS / f'{name}.yaml'
    assert read_tour(path)[-1] == pytest.approx([float(v) for v in _start(path)])


def _start(path: Path) -> list[str]:
    (line,) = [line for line in path.read_text().splitlines() if line.startswith('start:')]
    return line.removeprefix('start: [').rstrip(']').split(',')[:2]


def test_the_long_tour_takes_twenty_minutes() -> None:
    world, tour = load('floor_70x10')
    length = np.hypot(*np.diff(np.vstack([world.start[:2], tour]), axis=0).T).sum()
    assert 200.0 < length < 280.0


def test_the_warehouse_is_what_its_program_writes() -> None:
    assert (WORLDS / 'warehouse.yaml').read_text(encoding='utf-8') == warehouse_yaml()


def test_an_unreachable_place_is_reported() -> None:
    world, _ = load('office')
    with pytest.raises(InputError, match=r'office: tour: \[20\.0, 3\.0\]'):
        list(tour_paths(world, np.array([[20.0, 3.0]]), 0.22))


def test_the_same_seed_drives_the_same() -> None:
    world, tour = load('dead_end')

    def ranges() -> np.ndarray:
        simulation = Simulation(world, world.start, PRESETS['2dx'], LaserScannerConfig(), 3)
        return np.array(
            [
                x.scan.ranges_m
                for x in drive(simulation, tour_paths(world, tour[:1], 0.22), DriveConfig(1.0))
            ]
        )

    assert np.array_equal(ranges(), ranges())


def test_an_invalid_tour_is_reported(tmp_path: Path) -> None:
    path = tmp_path / 'w.yaml'
    path.write_text('tour: [[1, 2], [3]]\n')
    with pytest.raises(InputError, match=r'w\.yaml: tour'):
        read_tour(path)
    path.write_text('walls: []\n')
    assert read_tour(path).shape == (0, 2)
