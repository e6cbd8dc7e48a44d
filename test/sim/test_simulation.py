"""The simulation: its clock, the rates of its sensors, and reproducibility by a seed."""

import numpy as np
import pytest

from thinmap_ros.core.errors import ConfigError, InputError
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.scan import Scan
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.simulation import STEP_NS, SensorReadings, Simulation
from thinmap_ros.sim.world import World

TWO = 'front 0.4,0.2,0.8; rear -0.3,-0.2,-2.3'


def simulation(seed: int = 1, rate_hz: float = 5.0, lasers: str = '') -> Simulation:
    cells = np.zeros((60, 60), dtype=np.uint8)
    cells[0] = 1
    cells[-1] = 1
    cells[:, 0] = 1
    cells[:, -1] = 1
    world = World('box', cells, GridFrame(0.0, 0.0, 0.1), np.array([3.0, 3.0, 0.0]))
    laser = LaserScannerConfig(scan_rate_hz=rate_hz, lasers=lasers)
    return Simulation(world, world.start, PRESETS['2dx'], laser, seed)


def drive(sim: Simulation, steps: int) -> list[SensorReadings]:
    return [sim.read_sensors()] + [sim.step(0.2, 0.3) for _ in range(steps)]


def test_time_and_rates_are_exact() -> None:
    moments = drive(simulation(), 200)
    assert [m.stamp_ns for m in moments] == [i * STEP_NS for i in range(201)]
    scans = [scan.stamp_ns for m in moments for scan in m.scans]
    assert scans == [i * 200_000_000 for i in range(51)]
    assert 1e9 / STEP_NS >= 10.0


def test_a_rate_off_the_steps_is_kept_on_average() -> None:
    moments = drive(simulation(rate_hz=7.0), 2000)
    assert sum(len(m.scans) for m in moments) == pytest.approx(700, abs=1)


def test_a_due_scan_is_given_once() -> None:
    sim = simulation()
    assert len(sim.read_sensors().scans) == 1
    assert sim.read_sensors().scans == ()


def test_same_seed_same_run() -> None:
    first, second, other = (drive(simulation(seed), 50) for seed in (4, 4, 5))
    for a, b in zip(first, second, strict=True):
        assert np.array_equal(a.T_odom_base, b.T_odom_base)
        for one, again in zip(a.scans, b.scans, strict=True):
            assert np.array_equal(one.ranges_m, again.ranges_m)
    assert not np.array_equal(first[-1].T_odom_base, other[-1].T_odom_base)


def scans_of(sim: Simulation, steps: int) -> list[Scan]:
    return [scan for moment in drive(sim, steps) for scan in moment.scans]


def test_each_laser_has_its_frame_and_mount_and_they_alternate() -> None:
    scans = scans_of(simulation(lasers=TWO), 8)
    assert [scan.frame for scan in scans] == 2 * ['front_laser', 'rear_laser'] + ['front_laser']
    assert [scan.stamp_ns for scan in scans] == [k * 100_000_000 for k in range(5)]
    assert scans[0].T_base_laser == pytest.approx([0.4, 0.2, 0.8])
    assert scans[1].T_base_laser == pytest.approx([-0.3, -0.2, -2.3])
    assert [mount.topic for mount in LaserScannerConfig(lasers=TWO).mounts()] == [
        'front/scan',
        'rear/scan',
    ]


def test_a_laser_at_a_corner_sees_the_walls_from_there() -> None:
    scan = simulation(lasers='left 0.4,0.2,1.5708').read_sensors().scans[0]
    ahead = scan.ranges_m[scan.ranges_m.size // 2]
    assert ahead == pytest.approx(2.9 - 0.2, abs=0.05)


def test_each_laser_has_noise_of_its_own_and_the_first_one_that_of_a_single_laser() -> None:
    same_place = 'a 0,0,0; b 0,0,0'
    first, other = (
        [scan.ranges_m for scan in scans_of(simulation(lasers=same_place), 16) if scan.frame == f]
        for f in ('a_laser', 'b_laser')
    )
    alone = scans_of(simulation(), 16)
    assert {scan.frame for scan in alone} == {'laser'}
    for one, scan in zip(first, alone, strict=True):
        assert np.array_equal(one, scan.ranges_m)
    assert not np.array_equal(first[0], other[0])


@pytest.mark.parametrize(
    'lasers',
    [
        'front',
        'front 1,2',
        'front 1,2,nan',
        'front 1000,0,0',
        'Front 0,0,0',
        'a/b 0,0,0',
        '0,0,0',
        'front 0,0,0;',
        'front 0,0,0; front 1,0,0',
    ],
)
def test_lasers_without_a_name_or_a_pose_are_refused(lasers: str) -> None:
    with pytest.raises(ConfigError, match=r'lasers = .*expected "NAME x,y,yaw'):
        LaserScannerConfig(lasers=lasers)


@pytest.mark.parametrize('start', [[0.2, 3.0, 0.0], [-5.0, 3.0, 0.0], [np.nan, np.nan, 0.0]])
def test_a_start_in_a_wall_is_refused(start: list[float]) -> None:
    world = simulation().world
    with pytest.raises(InputError, match='start'):
        Simulation(world, np.array(start), PRESETS['2dx'], LaserScannerConfig(), 0)
