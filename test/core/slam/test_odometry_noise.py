"""The share of the allowed noise is learned from matches, and never from what they cannot tell."""

import numpy as np
import pytest

from thinmap_ros.core.slam.doubt import Evidence
from thinmap_ros.core.slam.odometry_noise import OdometryNoise
from thinmap_ros.core.slam.wheel_noise import MotionConfig, odometry_covariance, odometry_variances

CONFIG = MotionConfig()
SURE = Evidence(np.eye(3), np.eye(3), 100.0 * np.eye(3))
SEEDS = range(5)


def learned(share, steps=2000, seed=0, evidence=SURE, heading=0.7, slip_every=0):
    """What is learned on a drive whose noise has a share (2,) of the variance that is allowed."""
    rng, noise = np.random.default_rng(seed), OdometryNoise(CONFIG)
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    for k in range(steps):
        increment = np.array([rng.uniform(0.0, 0.1), 0.0, rng.uniform(-0.2, 0.2)])
        noise.move(increment)
        by_chord, by_turn = rng.normal(0.0, np.sqrt(odometry_variances(increment, CONFIG) * share))
        off = ahead * by_chord + np.array([0.0, 0.0, by_turn])
        if slip_every and k % slip_every == 0:
            off = off + np.array([0.3, 0.3, 0.5])
        noise.learn(off, evidence, heading)
    return noise.share


@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize('share', [(0.3, 0.6), (0.8, 0.15), (0.5, 0.5)])
def test_it_finds_the_share_that_there_is(share, seed):
    assert learned(np.array(share), seed=seed) == pytest.approx(share, rel=0.35)


@pytest.mark.parametrize('seed', SEEDS)
def test_it_never_expects_more_than_is_allowed_nor_next_to_nothing(seed):
    assert (learned(np.array([4.0, 9.0]), seed=seed) <= 1.0).all()
    assert (learned(np.zeros(2), seed=seed) >= 0.1).all()


@pytest.mark.parametrize('seed', SEEDS)
def test_a_slip_now_and_then_is_not_taken_for_noise(seed):
    assert (learned(np.array([0.2, 0.2]), seed=seed, slip_every=100) < 0.5).all()


def test_what_the_map_leaves_open_tells_nothing():
    corridor = Evidence(np.eye(3), np.eye(3), np.diag([0.1, 100.0, 100.0]))
    share = learned(np.array([0.3, 0.3]), evidence=corridor, heading=0.0)
    assert share[0] == 1.0 and share[1] < 0.5


def test_it_begins_with_all_that_is_allowed_and_stands_still_where_nothing_is():
    assert OdometryNoise(CONFIG).share.tolist() == [1.0, 1.0]
    exact = OdometryNoise(
        MotionConfig(odom_distance_sigma=0.0, odom_turn_sigma=0.0, odom_drift_sigma=0.0)
    )
    exact.move(np.array([0.1, 0.0, 0.1]))
    exact.learn(np.zeros(3), SURE, 0.0)
    assert exact.share.tolist() == [1.0, 1.0]


def test_the_covariance_of_an_increment_takes_the_share():
    increment = np.array([0.2, 0.0, 0.0])
    whole = odometry_covariance(increment, CONFIG)
    part = odometry_covariance(increment, CONFIG, np.array([0.5, 0.1]))
    slip = np.diag(np.square([CONFIG.odom_slip_m, CONFIG.odom_slip_m, CONFIG.odom_slip_rad]))
    assert (part - slip)[0, 0] == pytest.approx(0.5 * (whole - slip)[0, 0])
    assert (part - slip)[1:, 1:] == pytest.approx(0.1 * (whole - slip)[1:, 1:])
