"""Heading measured by wall directions, in Manhattan worlds and elsewhere."""

import numpy as np
import pytest
from support.slam_room import ROOM, corridor, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.features import LineConfig, extract_lines, no_lines
from thinmap_ros.core.slam.graph.pose_graph import NO_SHARE
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.wall_compass import Reference, WallCompass

PLACES = np.array(
    [[2.0, 2.0, 0.0], [5.5, 4.0, 1.0], [4.1, 7.0, 2.0], [8.5, 8.0, -2.0], [1.0, 8.0, -0.5]]
)
TURNED = 0.3
SURE = Reference(1e-6, NO_SHARE)


def lines_at(place, rng, walls=ROOM):
    return extract_lines(scan_in(walls, place, rng), LineConfig())


def learned(rng, walls=ROOM, turned=TURNED, looks=20):
    """Compass after a round in a map that is rotated against the walls."""
    compass = WallCompass()
    for k in range(looks):
        place = PLACES[k % len(PLACES)] + [0.0, 0.0, 0.2 * k]
        compass.add_lines(lines_at(place, rng, walls), place[2] + turned, 0.3 * k, SURE)
    return compass


@pytest.mark.parametrize('turned', [0.0, 0.3, 1.569])
def test_the_main_direction_of_the_walls_is_found(turned, rng):
    off = learned(rng, turned=turned).direction - turned
    assert abs((off + np.pi / 4) % (np.pi / 2) - np.pi / 4) < 0.002


def test_a_scan_corrects_the_heading_drift_of_odometry(rng):
    compass = learned(rng)
    for wrong in (-0.15, -0.02, 0.05, 0.15):
        told = compass.read(lines_at(PLACES[1], rng), PLACES[1, 2] + TURNED + wrong, 0.06**2)
        assert abs(told.yaw - PLACES[1, 2] - TURNED) < 0.006
        assert 0.0 < told.variance < 0.01**2


def test_walls_in_other_directions_measure_no_heading(rng):
    compass = learned(rng)
    assert compass.read(lines_at(PLACES[1], rng), PLACES[1, 2] + TURNED + 0.05, 0.005**2) is None
    assert compass.read(no_lines(), 0.0, 1.0) is None


def test_nothing_is_believed_before_enough_was_seen(rng):
    assert WallCompass().direction is None
    assert learned(rng, looks=1).direction is None


def test_walls_of_a_round_room_have_no_main_direction(rng):
    corners = np.array(
        [[5.0 + 4.5 * np.cos(a), 5.0 + 4.5 * np.sin(a)] for a in np.linspace(0, 2 * np.pi, 8)]
    )
    assert learned(rng, np.hstack([corners[:-1], corners[1:]])).direction is None


def test_what_was_seen_where_the_map_began_counts_most(rng):
    """Later walls contain the heading drift up to then."""
    compass = learned(rng)
    for k in range(60):
        place = PLACES[k % len(PLACES)]
        compass.add_lines(lines_at(place, rng), place[2] + TURNED + 0.02, 100.0 + k, SURE)
    assert abs(compass.direction - TURNED) < 0.006


@pytest.mark.parametrize('askew_deg', [0.0, 4.0, 20.0])
def test_a_wing_that_stands_askew_is_mapped_as_it_stands(askew_deg, rng):
    """A corridor and another one behind its corner, at a right angle or not."""
    wing = se2.pose(21.2, 1.2, np.pi / 2.0 + np.radians(askew_deg))
    walls = np.vstack(
        [corridor(20.0), se2.transform_points(wing, corridor(14.0).reshape(-1, 2)).reshape(-1, 4)]
    )
    corner = [
        [20.0, -1.2, 22.9, -1.2],
        [22.9, -1.2, *se2.transform_points(wing, np.array([[0.0, -1.2]]))[0]],
    ]
    walls = np.vstack([walls, corner])
    localizer = Localizer()
    odom = np.zeros(3)
    truth = np.zeros(3)
    stamp_ns = 0
    goals = [[20.8, 0.0], *se2.transform_points(wing, np.array([[0.5, 0.0], [12.0, 0.0]]))]
    for goal in goals:
        while np.hypot(*(goal - truth[:2])) > 0.15:
            turn = float(
                np.clip(se2.wrap(np.arctan2(*(goal - truth[:2])[::-1]) - truth[2]), -0.12, 0.12)
            )
            step = np.array([0.1 if abs(turn) < 0.1 else 0.0, 0.0, turn])
            truth = se2.compose(truth, step)
            odom = se2.compose(odom, step + [0.0, 0.0, rng.normal(0.0, 0.003)])
            stamp_ns += 200_000_000
            estimate = localizer.step(scan_in(walls, truth, rng, stamp_ns), odom)
            off = se2.between(truth, estimate.T_map_base)
            assert abs(off[2]) < 0.02
    assert np.hypot(*off[:2]) < 0.25
