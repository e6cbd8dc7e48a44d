"""Surface points: normals from neighbours on one surface, and no false surfaces."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support.slam_room import RANGE_MAX_M, ROOM, ranges_in, scan_in, seen_in

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.slam.matching import surface
from thinmap_ros.core.slam.matching.surface import WINDOW_M, surface_points

RANGE_NOISE_M = 0.02  # as documented: neighbours with no more scatter lie on a plane


def normals_of(points):
    """Angles (N,) of the normals, in (-pi / 2, pi / 2]."""
    return 0.5 * np.arctan2(points[:, 3], points[:, 2])


def sureness_of(points):
    return np.hypot(points[:, 2], points[:, 3])


def off_normal(points, angle):
    """Angles (N,) between the normals and a direction, degrees, without sign."""
    off = normals_of(points) - angle
    return np.degrees(np.abs((off + 0.5 * np.pi) % np.pi - 0.5 * np.pi))


# The reference: plain, from the description alone.


def are_linked(points, beams):
    """Whether each point (N,) is on the same surface as its predecessor."""
    linked = np.zeros(len(points), dtype=bool)
    steps = {
        k: points[k] - points[k - 1] for k in range(1, len(points)) if beams[k] == beams[k - 1] + 1
    }
    for k, step in steps.items():
        linked[k] = np.hypot(*step) < WINDOW_M
        for other in (steps.get(k - 1), steps.get(k + 1)):
            if other is None:
                continue
            lengths = np.hypot(*step), np.hypot(*other)
            if min(lengths) > 0.0:
                cosine = step @ other / (lengths[0] * lengths[1])
                alike = max(lengths) / min(lengths) < 3.0
                linked[k] |= cosine > math.sqrt(0.8) and alike
    return linked


def neighbours_of(i, points, linked):
    """Linked neighbours on either side, up to the first one beyond the window."""
    found = []
    for side in (-1, 1):
        k = i
        while 0 <= k + side < len(points) and linked[max(k, k + side)]:
            k += side
            found.append(k)
            if np.hypot(*(points[k] - points[i])) >= WINDOW_M:
                break
    return found


def reference(points, beams):
    linked = are_linked(points, beams)
    rows = []
    for i, point in enumerate(points):
        near = neighbours_of(i, points, linked)
        if not near:
            continue
        sizes, directions = np.linalg.eigh(np.cov(points[[i, *near]].T, bias=True))
        across = max(sizes[0] - RANGE_NOISE_M**2, 0.0)
        sure = (sizes[1] - across) / (sizes[1] + across)
        n = directions[:, 0]
        double = sure * np.array([n[0] ** 2 - n[1] ** 2, 2.0 * n[0] * n[1]])
        gap = np.hypot(*(points[near] - point).T).min()
        rows.append([*point, *double, gap])
    return np.array(rows).reshape(-1, 5)


def polyline(rng, number):
    """Points on walls with bends, jumps and varying distance; some beams are missing."""
    turns = np.where(rng.random(number) < 0.15, rng.uniform(-2.0, 2.0, number), 0.0)
    lengths = rng.choice([0.02, 0.05, 0.12, 0.3, 1.5], number, p=[0.3, 0.3, 0.2, 0.15, 0.05])
    headings = np.cumsum(turns)
    steps = lengths[:, None] * np.column_stack([np.cos(headings), np.sin(headings)])
    points = np.cumsum(steps, axis=0) + rng.normal(0.0, 0.01, (number, 2))
    beams = np.cumsum(rng.choice([1, 2, 7], number, p=[0.9, 0.07, 0.03]))
    return points, beams


@pytest.mark.parametrize('seed', range(12))
def test_surfaces_are_those_of_the_reference(seed):
    points, beams = polyline(np.random.default_rng(seed), 300)
    found = surface._surface(points, beams)
    assert 30 < len(found) < len(points), 'some points are alone'
    np.testing.assert_allclose(found, reference(points, beams), atol=1e-7)


def test_links_are_those_of_the_reference(rng):
    shares = []
    for _ in range(20):
        points, beams = polyline(rng, 200)
        linked = surface._links(points, beams)
        assert not linked[-1]
        np.testing.assert_array_equal(linked[:-1], are_linked(points, beams))
        shares.append(linked.mean())
    assert 0.3 < np.mean(shares) < 0.95


def test_kernels_are_what_they_are_in_plain_python(rng):
    points, beams = polyline(rng, 200)
    np.testing.assert_array_equal(
        surface._links(points, beams), surface._links.py_func(points, beams)
    )
    np.testing.assert_allclose(
        surface._surface(points, beams), surface._surface.py_func(points, beams), rtol=1e-12
    )


@pytest.mark.parametrize('incidence', np.radians([0.0, 20.0, 40.0, 60.0, 70.0]))
@pytest.mark.parametrize('away_m', [1.0, 3.0])
def test_normals_of_a_flat_wall_at_all_incidences(rng, incidence, away_m):
    """At 1 cm noise and half a degree between beams; the middle beam is oblique to the wall."""
    normal = np.array([math.cos(incidence), math.sin(incidence)])
    along = np.array([-normal[1], normal[0]])
    middle = np.array([away_m, 0.0])
    wall = np.array([[*(middle - 2.0 * along), *(middle + 2.0 * along)]])
    off = []
    number = 0
    for _ in range(20):
        scan = scan_in(wall, np.zeros(3), rng, beams=361)
        points = surface_points(scan)
        number += np.count_nonzero(scan.hit)
        inside = np.abs((points[:, :2] - middle) @ along) < 1.8
        off.append(off_normal(points[inside], incidence))
        assert (sureness_of(points[inside]) > 0.5).mean() > 0.95
    off = np.concatenate(off)
    assert len(off) > 0.6 * number
    # 1 cm over a window of 15 cm on either side.
    assert np.sqrt(np.mean(off**2)) < 4.0
    assert np.abs(off).max() < 20.0


def test_normals_without_noise_are_exact_on_a_turned_robot():
    """In the robot frame, for any mount of the laser."""
    wall = np.array([[3.0, -20.0, 3.0, 20.0]])
    for mount in ([0.0, 0.0, 0.0], [0.2, -0.1, 0.4]):
        for heading in (0.0, 0.5, -0.7):
            scan = scan_in(wall, np.array([0.0, 0.0, heading]), T_base_laser=np.array(mount))
            points = surface_points(scan)
            assert len(points) > 50
            assert off_normal(points, -heading).max() < 1e-3
            np.testing.assert_allclose(sureness_of(points), 1.0, atol=1e-6)
            on_the_wall = se2.transform_points(np.array([0.0, 0.0, heading]), points[:, :2])
            np.testing.assert_allclose(on_the_wall[:, 0], 3.0, atol=1e-5)


def test_a_jump_between_two_walls_is_no_surface():
    """A wall ends in front of another one; both have their own normals up to the last beam."""
    walls = np.array([[2.0, 2.0, 2.0, 0.0], [3.0, 0.4, 3.4, -3.0]])
    points = seen_in(walls, np.zeros(3))
    near = points[:, 0] < 2.5
    assert near.any()
    assert not near.all()
    assert off_normal(points[near], 0.0).max() < 1e-3
    assert off_normal(points[~near], math.atan2(0.4, 3.4)).max() < 1e-3
    np.testing.assert_allclose(sureness_of(points), 1.0, atol=1e-6)


def test_a_beam_that_met_nothing_parts_its_neighbours():
    """Two collinear walls, 20 cm apart; the beam through the gap has no return."""
    points = np.column_stack([np.ones(6), 0.2 * np.arange(6)])
    beams = np.arange(6)
    assert surface._links(points, beams)[1:6].all()
    beams[3:] += 1
    assert surface._links(points, beams)[1:6].tolist() == [True, True, False, True, True]


CORRIDOR = np.array([[-50.0, -1.0, 50.0, -1.0], [50.0, 1.0, -50.0, 1.0]])


def in_corridor(rng, beams, edges=False):
    """Surface points, and the errors of their normals, degrees."""
    pose = np.array([0.0, rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3)])
    if edges:
        scan = scan_in(CORRIDOR, pose, rng, beams=beams)
    else:
        step = math.pi / (beams - 1)
        ranges = ranges_in(CORRIDOR, pose, step * np.arange(beams) - math.pi / 2.0)
        ranges = np.minimum(ranges, 2.0 * RANGE_MAX_M) + rng.normal(0.0, 0.01, beams)
        scan = Scan.create(0, ranges, -math.pi / 2.0, step, 0.05, RANGE_MAX_M)
    points = surface_points(scan)
    assert len(points) > 0.4 * beams
    return points, off_normal(points, 0.5 * math.pi - pose[2])


@pytest.mark.parametrize('beams', [61, 181, 721])
def test_across_a_corridor_there_is_no_surface(rng, beams):
    """The last beams of both walls, at the range limit of 8 m, are neighbours in the scan only."""
    far = 0
    for _ in range(50):
        points, off = in_corridor(rng, beams)
        assert off.max() < 20.0
        assert np.sqrt(np.mean(off**2)) < 3.0
        far += np.count_nonzero(np.hypot(*points[:, :2].T) > 6.0)
    assert far > 20


def test_few_ranges_in_between_make_a_surface_across_a_corridor(rng):
    """A third of the beams at range jumps end between the two surfaces (mixed pixels)."""
    off = np.concatenate([in_corridor(rng, 181, edges=True)[1] for _ in range(200)])
    assert 0.0 < np.mean(off > 20.0) < 0.002


def test_points_that_are_left_out_part_the_scan_too():
    """Points beyond the range are dropped, and do not link others."""
    walls = np.array([[-50.0, -1.0, 50.0, -1.0], [50.0, 1.0, -50.0, 1.0], [7.0, -1.0, 7.0, 1.0]])
    scan = scan_in(walls, np.zeros(3), beams=61)
    points = surface_points(replace(scan, max_range_m=5.0))
    assert np.hypot(*points[:, :2].T).max() < 5.0
    assert off_normal(points, 0.5 * math.pi).max() < 1e-3
    assert len(surface_points(scan)) > len(points)
    assert len(surface_points(replace(scan, max_range_m=0.9))) == 0


def test_lone_points_are_dropped():
    """A thin post in front of a wall, hit by one beam, and mixed pixels at its edges."""
    wall = [4.0, -8.0, 4.0, 8.0]
    post = [2.0, -0.005, 2.0, 0.005]
    points = seen_in(np.array([wall, post]), np.zeros(3))
    assert points[:, 0].min() > 3.9
    assert len(points) > 100
    both = np.array([wall, [2.0, -0.05, 2.0, 0.05]])  # a thick one is hit by three
    assert np.count_nonzero(seen_in(both, np.zeros(3))[:, 0] < 3.0) == 3


def test_a_corner_is_less_sure_than_a_wall():
    walls = np.array([[2.0, -2.0, 2.0, 1.0], [2.0, 1.0, -2.0, 1.0]])
    points = seen_in(walls, np.zeros(3))
    away = np.hypot(*(points[:, :2] - [2.0, 1.0]).T)
    assert sureness_of(points)[away.argmin()] < 0.7
    np.testing.assert_allclose(sureness_of(points[away > 0.5]), 1.0, atol=1e-6)


def test_what_scatters_has_no_sure_normal(rng):
    """A bush: ranges of adjacent beams differ by much more than their noise."""
    points = np.column_stack([2.0 + rng.normal(0.0, 0.05, 300), 0.01 * np.arange(300)])
    found = surface._surface(points, np.arange(300))
    assert len(found) > 280
    assert np.median(sureness_of(found)) < 0.7
    points[:, 0] = 2.0 + rng.normal(0.0, 0.01, 300)
    assert np.median(sureness_of(surface._surface(points, np.arange(300)))) > 0.98


def test_the_spacing_is_the_gap_to_the_nearest_neighbour_on_the_surface():
    y = np.array([0.0, 0.02, 0.05, 0.15, 0.16])
    points = np.column_stack([np.ones(5), y])
    beams = np.array([0, 1, 2, 3, 5])
    found = surface._surface(points, beams)
    np.testing.assert_array_equal(found[:, 1], y[:4], 'the last one is alone')
    np.testing.assert_allclose(found[:, 4], [0.02, 0.02, 0.03, 0.1])


def test_an_empty_scan_has_no_surface():
    nothing = seen_in(np.array([[1e3, -1.0, 1e3, 1.0]]), np.zeros(3))
    assert nothing.shape == (0, 5)
    assert surface_points(scan_in(ROOM, np.array([5.0, 3.0, 0.0]), beams=2)).shape == (0, 5)


def test_a_clockwise_laser_sees_the_same(rng):
    pose = np.array([2.0, 2.0, 0.3])
    one, other = (
        surface_points(scan_in(ROOM, pose, clockwise=clockwise)) for clockwise in (False, True)
    )
    np.testing.assert_allclose(one, other[::-1], atol=1e-5)


@settings(max_examples=150)
@given(data=st.data(), number=st.integers(0, 40))
def test_any_points_of_any_beams_have_a_surface(data, number):
    """Also for coincident or collinear points; the input is not changed."""
    coordinates = st.sampled_from([-0.1, 0.0, 0.05, 0.1, 0.1000001, 2.0]) | st.floats(-30.0, 30.0)
    flat = data.draw(st.lists(coordinates, min_size=2 * number, max_size=2 * number))
    gaps = data.draw(st.lists(st.integers(1, 3), min_size=number, max_size=number))
    points = np.array(flat, dtype=float).reshape(-1, 2)
    beams = np.cumsum(gaps, dtype=np.int64)
    # No laser has two adjacent beams with identical end points.
    assume(np.hypot(*np.diff(points, axis=0).T).min(initial=1.0) > 1e-9)
    given_points = points.copy()
    given_beams = beams.copy()
    found = surface._surface(points, beams)
    np.testing.assert_array_equal(points, given_points)
    np.testing.assert_array_equal(beams, given_beams)
    assert np.isfinite(found).all()
    assert (sureness_of(found) <= 1.0 + 1e-9).all()
    assert (found[:, 4] >= 0.0).all()
    linked = are_linked(points, beams)
    kept = linked | np.append(linked[1:], False)
    np.testing.assert_array_equal(found[:, :2], points[kept[: len(points)]])
    np.testing.assert_allclose(found, surface._surface.py_func(points, beams), atol=1e-9)
