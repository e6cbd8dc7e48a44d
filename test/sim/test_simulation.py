"""The simulation: its clock, the rates of its sensors, and reproducibility by a seed."""

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.simulation import STEP_NS, SensorReadings, Simulation
from thinmap_ros.sim.world import World


def simulation(seed: int = 1, rate_hz: float = 5.0) -> Simulation:
    cells = np.zeros((60, 60), dtype=np.uint8)
    cells[0] = 1
    cells[-1] = 1
    cells[:, 0] = 1
    cells[:, -1] = 1
    world = World('box', cells, GridFrame(0.0, 0.0, 0.1), np.array([3.0, 3.0, 0.0]))
    return Simulation(
        world, world.start, PRESETS['2dx'], LaserScannerConfig(scan_rate_hz=rate_hz), seed
    )


def drive(sim: Simulation, steps: int) -> list[SensorReadings]:
    return [sim.read_sensors()] + [sim.step(0.2, 0.3) for _ in range(steps)]


def test_time_and_rates_are_exact() -> None:
    moments = drive(simulation(), 200)
    assert [m.stamp_ns for m in moments] == [i * STEP_NS for i in range(201)]
    scans = [m.scan.stamp_ns for m in moments if m.scan is not None]
    assert scans == [i * 200_000_000 for i in range(51)]
    assert 1e9 / STEP_NS >= 10.0


def test_a_rate_off_the_steps_is_kept_on_average() -> None:
    moments = drive(simulation(rate_hz=7.0), 2000)
    assert sum(m.scan is not None for m in moments) == pytest.approx(700, abs=1)


def test_a_due_scan_is_given_once() -> None:
    sim = simulation()
    assert sim.read_sensors().scan is not None
    assert sim.read_sensors().scan is None


def test_same_seed_same_run() -> None:
    first, second, other = (drive(simulation(seed), 50) for seed in (4, 4, 5))
    for a, b in zip(first, second, strict=True):
        assert np.array_equal(a.T_odom_base, b.T_odom_base)
        assert (a.scan is None) == (b.scan is None)
        assert a.scan is None or b.scan is None or np.array_equal(a.scan.ranges_m, b.scan.ranges_m)
    assert not np.array_equal(first[-1].T_odom_base, other[-1].T_odom_base)


@pytest.mark.parametrize('start', [[0.2, 3.0, 0.0], [-5.0, 3.0, 0.0], [np.nan, np.nan, 0.0]])
def test_a_start_in_a_wall_is_refused(start: list[float]) -> None:
    world = simulation().world
    with pytest.raises(InputError, match='start'):
        Simulation(world, np.array(start), PRESETS['2dx'], LaserScannerConfig(), 0)
