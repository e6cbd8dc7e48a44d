"""Consistency: pose errors match the filter's covariance over many runs (NEES)."""

import math

import numpy as np
import pytest
from scipy.stats import chi2
from support.slam_room import BLIND

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.ekf import CompressedEkf
from thinmap_ros.core.ekf_slam.feature_map import (
    WALL_FLATNESS_M,
    AssociationConfig,
    FeatureConfig,
    FeatureMap,
)
from thinmap_ros.core.ekf_slam.features import Lines, observe_line

FEATURES = FeatureConfig()
# Noise of a step forward and of a rotation.
AHEAD = np.diag(np.square([0.011, 0.003, 0.006]))
TURN = np.diag(np.square([0.002, 0.002, 0.017]))
SEEN = np.diag([0.01**2, 0.005**2])
RANGE_M = 8.0


def floor():
    """Two rows of rooms along a corridor of 40 m: walls as end points (N, 2, 2)."""
    walls = [[[0.0, y], [40.0, y]] for y in (0.0, 10.0)]
    for x in np.arange(0.0, 41.0, 5.0):
        walls += [[[x, 0.0], [x, 4.0]], [[x, 6.0], [x, 10.0]]]
    for x in np.arange(0.0, 40.0, 5.0):
        walls += [[[x + 0.2, y], [x + 3.5, y]] for y in (4.0, 6.0)]
    return np.array(walls)


WALLS = floor()
NORMALS = np.column_stack([-(WALLS[:, 1] - WALLS[:, 0])[:, 1], (WALLS[:, 1] - WALLS[:, 0])[:, 0]])
NORMALS = NORMALS / np.hypot(*NORMALS.T)[:, None]
TRUE_LINES = np.column_stack(
    [(NORMALS * WALLS[:, 0]).sum(axis=1), np.arctan2(NORMALS[:, 1], NORMALS[:, 0])]
)


def look(rng, truth):
    """Noisy lines of the walls whose centre is in range and ahead."""
    middles = WALLS.mean(axis=1)
    # The part of long walls near the robot.
    middles[:2, 0] = truth[0]
    off = se2.transform_points(se2.invert(truth), middles)
    seen = np.flatnonzero((np.hypot(*off.T) < RANGE_M) & (off[:, 0] > -0.5))
    z = np.array([observe_line(truth, TRUE_LINES[i])[0] for i in seen]).reshape(-1, 2)
    seen = seen[z[:, 0] > 0.3]
    z = z[z[:, 0] > 0.3]
    ends = np.array([se2.transform_points(se2.invert(truth), WALLS[i]) for i in seen])
    ends = ends.reshape(-1, 2, 2)
    lengths = np.hypot(*(ends[:, 1] - ends[:, 0]).T)
    wall = WALL_FLATNESS_M * np.column_stack([np.ones(len(z)), 1.0 / lengths])
    z = z + rng.multivariate_normal([0.0, 0.0], SEEN, len(z)) + wall * rng.normal(size=(len(z), 2))
    return Lines(z, np.tile(SEEN, (len(z), 1, 1)), ends)


def nees_of_a_run(seed, local_areas, looks):
    """NEES of the pose at each observation of a drive up and down the corridor."""
    rng = np.random.default_rng(seed)
    truth = np.array([2.0, 5.0, 0.0])
    ekf = CompressedEkf(truth, 1e-8 * np.eye(3))
    features = FeatureMap(FEATURES, AssociationConfig(), local_areas)
    found = []
    for step in range(looks):
        turning = step % 120 >= 110
        increment = np.array([0.0 if turning else 0.3, 0.0, math.pi / 10.0 if turning else 0.0])
        truth = se2.compose(truth, increment)
        Q = TURN if turning else AHEAD
        measured = increment + rng.multivariate_normal(np.zeros(3), Q)
        ekf.local.predict(se2.compose(ekf.local.pose, measured), measured, Q)
        features.observe(ekf, look(rng, truth), BLIND)
        ekf.flush_step()
        error = ekf.local.pose - truth
        error[2] = se2.wrap(float(error[2]))
        found.append(error @ np.linalg.solve(ekf.local.pose_covariance, error))
    return found


def share_inside(runs, looks, local_areas):
    nees = np.mean([nees_of_a_run(seed, local_areas, looks) for seed in range(runs)], axis=0)
    low, high = chi2.ppf([0.025, 0.975], 3 * runs) / runs
    return float(np.mean((nees >= low) & (nees <= high))), float(nees.mean())


@pytest.mark.parametrize('local_areas', [True, False])
def test_the_errors_match_the_covariance_of_the_filter(local_areas):
    inside, mean = share_inside(24, 120, local_areas)
    assert inside >= 0.85
    assert 2.0 < mean < 4.2


@pytest.mark.slow
@pytest.mark.parametrize('local_areas', [True, False])
def test_fifty_runs_stay_inside_the_band_of_95_percent(local_areas):
    inside, _ = share_inside(50, 240, local_areas)
    assert inside >= 0.9
