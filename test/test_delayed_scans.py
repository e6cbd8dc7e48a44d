"""Replays of a simulated drive whose scans are stamped late, or whose odometry is scaled."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.files.worlds import read_world
from thinmap_ros.logs.log import OdometryEvent, ScanEvent, SkippedRecords
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.replaying import replay
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import RobotConfig
from thinmap_ros.sim.simulation import STEP_NS, Simulation
from thinmap_ros.sim.world import World

WORLD = Path(__file__).parents[1] / 'worlds' / 'office.yaml'
DELAY_S = 0.2


@pytest.fixture(scope='module')
def drive():
    """Readings, and true poses (3,) of a robot that turns, and drives back and forth."""
    name, patch, start = read_world(WORLD)
    world = World.from_patch(name, patch, start)
    simulation = Simulation(world, start, RobotConfig(radius_m=0.17), LaserScannerConfig(), 1)
    readings = []
    for k in range(round(30.0 * SECOND_NS / STEP_NS)):
        phase = k * STEP_NS / SECOND_NS % 6.0
        v = 0.4 if 1.0 <= phase < 2.5 else -0.4 if 4.0 <= phase < 5.5 else 0.0
        w = 0.8 if phase < 1.0 else -0.8 if 3.0 <= phase < 4.0 else 0.0
        moment = simulation.step(v, w)
        readings.append((moment, simulation.robot.T_world_base))
    return readings


class Log:
    """A recording of readings, whose scans have stamps that are later by a delay."""

    expected_scans = None
    is_sorted = False

    def __init__(self, drive, delay_s):
        self.skipped = SkippedRecords()
        self.drive = drive
        self.delay_ns = round(delay_s * SECOND_NS)

    def events(self):
        for moment, _ in self.drive:
            yield OdometryEvent(moment.stamp_ns, moment.T_odom_base)
            for scan in moment.scans:
                stamp_ns = scan.stamp_ns + self.delay_ns
                yield ScanEvent(replace(scan, stamp_ns=stamp_ns, frame='laser'))


def errors(result, drive):
    """Errors (N, 3) of the poses against the true ones at the times of measurement."""
    stamps_ns = [moment.stamp_ns for moment, _ in drive]
    true = np.array([T for _, T in drive])
    at = result.measured_ns()
    truth = np.column_stack(
        [np.interp(at, stamps_ns, values) for values in (*true[:, :2].T, np.unwrap(true[:, 2]))]
    )
    T = se2.compose(truth[0], se2.invert(result.poses[0]))
    moved = np.array([se2.compose(T, pose) for pose in result.poses])
    difference = moved - truth
    difference[:, 2] = np.angle(np.exp(1j * difference[:, 2]))
    return difference


@pytest.mark.parametrize('delay_s', [DELAY_S, -DELAY_S])
def test_a_delay_is_told_and_corrected(drive, delay_s):
    result = replay(Log(drive, delay_s), PipelineConfig())
    assert result.delays_s['laser'] == pytest.approx(delay_s, abs=0.02)
    late = 'scans' if delay_s > 0.0 else 'odometry'
    (warning,) = result.warnings
    assert warning.startswith(f'stamps of the {late} are ')
    if delay_s > 0.0:
        x, y, yaw = np.sqrt(np.square(errors(result, drive)).mean(axis=0))
        assert np.hypot(x, y) < 0.02 and np.degrees(yaw) < 1.0


def test_stamps_without_delay_give_the_poses_of_the_pipeline_alone(drive):
    result = replay(Log(drive, 0.0), PipelineConfig())
    assert result.warnings == [] and result.delays_s == {'laser': 0.0}
    alone = Pipeline(PipelineConfig())
    pairs = [(scan, moment.T_odom_base) for moment, _ in drive for scan in moment.scans]
    poses = [alone.step(scan, T_odom_base).estimate.T_map_base for scan, T_odom_base in pairs]
    assert np.array_equal(result.poses, poses[: len(result.poses)])


def scaled(drive, distance, turn):
    """Warnings of a pipeline with the drive, and odometry that is scaled."""
    pipeline = Pipeline(PipelineConfig())
    T_odom = np.zeros(3)
    before = drive[0][0].T_odom_base
    for moment, _ in drive:
        moved = se2.between(before, moment.T_odom_base)
        before = moment.T_odom_base
        T_odom = se2.compose(T_odom, moved * [distance, distance, turn])
        for scan in moment.scans:
            pipeline.step(scan, T_odom)
    return pipeline.warnings


@pytest.mark.parametrize(
    ('distance', 'turn', 'texts', 'factors'),
    [
        (1.0, 1.26, ['odometry turns ', 'too far', 'the wheel separation to '], [1.26]),
        (1.0, 0.5, ['odometry turns ', 'too little', 'the wheel separation to '], [0.5]),
        (0.5, 1.0, ['odometry moves ', 'too little', 'the wheel radius to '], [2.0, 2.0]),
        (2.0, 2.0, ['turns ', ' and moves ', 'the wheel radius to '], [0.5, 1.0]),
    ],
)
def test_what_is_wrong_with_the_odometry_is_told_with_the_value_to_set(
    drive, distance, turn, texts, factors
):
    (warning,) = scaled(drive, distance, turn)
    assert all(text in warning for text in texts), warning
    assert '(sigma ' in warning
    found = [float(text) for text in re.findall(r'to (\d+\.\d\d) times', warning)]
    assert found == pytest.approx(factors, rel=0.06)


@pytest.mark.parametrize(('distance', 'turn'), [(1.0, 1.0), (1.05, 0.95), (1.0, 0.0), (0.0, 0.0)])
def test_of_an_odometry_that_is_usual_or_none_nothing_is_told(drive, distance, turn):
    assert scaled(drive, distance, turn) == []
