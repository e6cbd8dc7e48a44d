"""The delay of scans against the odometry, from turns."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thinmap_ros.core.odometry import OdometryBuffer
from thinmap_ros.core.scan import LaserConfig, Scan
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.core.sensing.delay import DelayEstimator
from thinmap_ros.core.stage import Estimate

SCAN_S = 1.0 / 7.0
ODOMETRY_S = 0.05


def turning(rng, seconds):
    """Times (s) and headings of a robot that turns and drives straight by turns."""
    times = np.arange(0.0, seconds, 0.01)
    rates = np.zeros(times.size)
    at = 0
    while at < times.size:
        end = at + int(rng.integers(50, 200))
        rates[at:end] = rng.choice([0.0, rng.uniform(-1.0, 1.0)])
        at = end
    # A robot takes a while to reach a speed.
    return times, np.cumsum(np.convolve(rates, np.ones(20) / 20.0, 'same')) * 0.01


class Drive:
    """Scans and odometry of a robot that turns, received by an estimator."""

    def __init__(self, delay_s, seed=0, scale=1.0, given_s=0.0, seconds=90.0):
        self.rng = np.random.default_rng(seed)
        self.estimator = DelayEstimator()
        self.buffer = OdometryBuffer()
        self.laser = LaserConfig(scan_delay_s=given_s)
        self.times, self.headings = turning(self.rng, seconds)
        self.run(delay_s, lambda heading: scale * heading)

    def run(self, delay_s, odometry):
        self.history = []
        next_s = 1.0
        for s in np.arange(0.0, self.times[-1], ODOMETRY_S):
            heading = odometry(np.interp(s, self.times, self.headings))
            self.buffer.add(round(s * SECOND_NS), np.array([0.0, 0.0, heading]))
            while next_s < s - 0.5:
                self.add_scan(next_s, next_s + delay_s)
                next_s += SCAN_S

    def add_scan(self, measured_s, stamp_s):
        heading = np.interp(measured_s, self.times, self.headings) + self.rng.normal(0.0, 0.002)
        scan = Scan.create(round(stamp_s * SECOND_NS), [1.0], 0.0, 0.1, 0.1, 8.0, laser=self.laser)
        found = Estimate(
            np.array([0.0, 0.0, heading]), np.eye(3), np.zeros(3), scan_information=np.eye(3)
        )
        self.estimator.add(self.estimator.with_delay(scan), found, self.buffer)
        self.history.append(self.estimator.applied)


@pytest.mark.parametrize('delay_s', [0.2, 0.1, -0.1, -0.2])
@pytest.mark.parametrize('scale', [1.0, 1.26, -1.0])
def test_a_delay_is_found_within_its_uncertainty_and_told(delay_s, scale):
    drive = Drive(delay_s, scale=scale)
    found = drive.estimator.applied
    assert abs(found.seconds - delay_s) < min(3.0 * found.sigma_s, 0.02)
    late = 'scans' if delay_s > 0.0 else 'odometry'
    assert drive.estimator.warning.startswith(f'stamps of the {late} are 0.')
    assert f'set scan_delay_s: {found.seconds:.2f}' in drive.estimator.warning
    known_s = [delay.seconds for delay in drive.history if delay.seconds]
    assert np.abs(np.diff(known_s)).max(initial=0.0) < 0.03


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_without_a_delay_none_is_found(seed):
    assert Drive(0.0, seed, seconds=60.0).estimator.warning == ''


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000), st.floats(-0.25, 0.25))
def test_the_standard_deviation_is_honest(seed, delay_s):
    drive = Drive(delay_s, seed, seconds=60.0)
    for found in drive.history:
        if math.isfinite(found.sigma_s):
            assert abs(found.seconds - delay_s) < 4.0 * found.sigma_s


def test_an_odometry_that_does_not_turn_shows_no_delay():
    assert Drive(0.2, scale=0.0).estimator.warning == ''


def test_a_turn_that_never_ends_shows_no_delay():
    drive = Drive(0.0, seconds=1.0)
    drive.times = np.arange(0.0, 60.0, 0.01)
    drive.headings = 0.3 * drive.times
    drive.buffer = OdometryBuffer()
    drive.run(0.2, lambda heading: heading)
    assert drive.estimator.warning == ''


def test_a_delay_is_estimated_besides_the_given_one():
    right = Drive(0.2, given_s=0.2).estimator
    assert right.warning == '' and right.total_s == 0.2
    wrong = Drive(0.2, given_s=0.05).estimator
    assert wrong.total_s == pytest.approx(0.2, abs=0.02)
    assert wrong.applied.seconds == pytest.approx(0.15, abs=0.02)


def test_a_delay_beyond_those_that_are_tried_is_not_taken_for_the_largest():
    assert Drive(0.8).estimator.applied.seconds == 0.0


def test_a_robot_that_does_not_change_its_heading_shows_nothing():
    drive = Drive(0.2, seconds=1.0)
    drive.times = np.arange(0.0, 30.0, 0.01)
    drive.headings = np.zeros(drive.times.size)
    drive.buffer = OdometryBuffer()
    drive.run(0.2, lambda heading: heading)
    assert drive.estimator.warning == ''


def test_a_clock_that_was_set_back_does_not_end_the_estimate():
    drive = Drive(0.0, seconds=1.0)
    drive.buffer.add(1000 * SECOND_NS, np.zeros(3))
    drive.add_scan(1000.0, 1000.0)
    drive.times, drive.headings = turning(drive.rng, 90.0)
    drive.buffer = OdometryBuffer()
    drive.run(0.2, lambda heading: heading)
    assert drive.estimator.applied.seconds == pytest.approx(0.2, abs=0.02)
