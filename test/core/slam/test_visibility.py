"""A laser without returns from walls of the map does not confirm the pose."""

from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import map_of, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.matching.local_map import LocalMap
from thinmap_ros.core.slam.matching.visibility import is_seen_through, seen_through

PERIOD_NS = 200_000_000
# A hall of 30 x 30 m: in its middle no wall is in range.
HALL = np.array(
    [[0.0, 0.0, 30.0, 0.0], [30.0, 0.0, 30.0, 30.0], [30.0, 30.0, 0.0, 30.0], [0.0, 30.0, 0.0, 0.0]]
)


class Hall:
    """A robot that has mapped a wall of a hall, and has gone so far that no wall is in range."""

    def __init__(self):
        self.rng = np.random.default_rng(5)
        self.localizer = Localizer()
        self.stamp_ns = 0
        self.odom = np.zeros(3)
        self.start = se2.pose(4.0, 15.0, 1.5)
        self.drive(20, se2.pose(0.05, 0.0, 0.05))  # turns to the wall of x = 0
        self.drive(15, se2.pose(0.05, 0.0, 0.05), towards=np.pi)
        self.drive(140, se2.pose(-0.1, 0.0, 0.0))

    @property
    def truth(self):
        return se2.compose(self.start, self.odom)

    def drive(self, steps, motion, towards=None, is_broken=False):
        """Estimates of a drive; towards: direction at which it stops to turn."""
        estimates = []
        for _ in range(steps):
            if towards is not None:
                turn = se2.wrap(towards - float(self.truth[2]))
                motion = se2.pose(0.0, 0.0, float(np.clip(turn, -0.3, 0.3)))
            self.odom = se2.compose(self.odom, motion)
            self.stamp_ns += PERIOD_NS
            scan = scan_in(HALL, self.truth, self.rng, self.stamp_ns)
            if is_broken:
                scan = replace(scan, ranges_m=np.full_like(scan.ranges_m, np.inf))
            estimates.append(self.localizer.step(scan, self.odom))
        return estimates


@pytest.fixture
def hall():
    return Hall()


SURE = np.zeros((3, 3))


def test_a_hall_without_walls_in_range_is_no_fault(hall):
    estimates = hall.drive(30, se2.pose(-0.02, 0.0, 0.0))
    assert estimates[-1].inlier_ratio == 0.0
    assert all(estimate.blind_reason == '' for estimate in estimates)


def test_the_wall_of_the_map_comes_in_range_without_a_return(hall):
    estimates = hall.drive(140, se2.pose(0.1, 0.0, 0.0), is_broken=True)
    blind = [k for k, estimate in enumerate(estimates) if estimate.blind_reason]
    assert 'walls of the map' in estimates[blind[0]].blind_reason
    assert blind == list(range(blind[0], len(estimates)))
    assert len(blind) > 20
    assert not any(estimate.is_lost for estimate in estimates)


def test_the_wall_is_matched_when_it_returns(hall):
    estimates = hall.drive(140, se2.pose(0.1, 0.0, 0.0))
    assert all(estimate.blind_reason == '' for estimate in estimates)
    assert estimates[-1].inlier_ratio > 0.8
    off = se2.between(hall.odom, estimates[-1].T_map_base)
    assert np.hypot(off[0], off[1]) < 0.1


def seen_ratio(*arguments):
    return seen_through(*arguments).ratio


def test_returns_behind_walls_are_counted_and_those_on_them_and_beside_them_not():
    wall = np.array([[3.0, -4.0, 3.0, 4.0]])
    behind = np.array([[6.0, -8.0, 6.0, 8.0]])
    side = np.array([[-1.0, 1.0, 6.0, 1.0]])
    here = np.zeros(3)
    seen = map_of(np.vstack([wall, side]), [here] * 3)
    assert seen_ratio(scan_in(np.vstack([wall, side]), here), seen, here, SURE) == 0.0
    through = scan_in(np.vstack([behind, side]), here)
    x = through.ranges_m * np.cos(through.angles_rad)
    expected = np.mean(np.isclose(x[through.returned], 6.0))
    assert seen_ratio(through, seen, here, SURE) == pytest.approx(expected, abs=0.05)
    assert expected > 0.2
    unsure = np.diag([1.5, 0.1, 0.01])
    assert seen_ratio(through, seen, here, unsure) < 0.02, 'drift of 3 m explains them'
    closer = scan_in(np.array([[2.0, -4.0, 2.0, 0.9]]), here)
    assert seen_ratio(closer, seen, here, SURE) == 0.0
    assert seen_ratio(through, LocalMap(), here, SURE) == 0.0


def test_of_two_parallel_walls_what_lies_between_tells_which_one_it_is():
    """A corridor beside a hall: from the hall its wall fits the far wall of the corridor."""
    corridor = np.array([[-10.0, 3.0, 10.0, 3.0], [-10.0, -3.0, 10.0, -3.0]])
    hall = np.array([[-10.0, 3.0, 10.0, 3.0], [-10.0, -12.0, 10.0, -12.0]])
    seen = map_of(corridor, [se2.pose(x, 0.0, 0.0) for x in (-3.0, -2.0, -1.0, 0.0, 1.0)])
    for x in (-1.5, -0.5, 0.5):
        here = se2.pose(x, 0.0, 0.3)
        assert is_seen_through(scan_in(hall, here), seen, here)
        assert not is_seen_through(scan_in(corridor, here), seen, here)
    here = np.zeros(3)
    wall = map_of(hall[:1], [here] * 3)
    assert not is_seen_through(scan_in(corridor, here), wall, here), 'unknown behind'
