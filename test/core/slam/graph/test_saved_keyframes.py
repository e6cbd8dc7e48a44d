"""Keyframes are saved as they are, to a millimetre, and without what belongs to no saved map."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import inverse
from thinmap_ros.core.slam.graph import keyframes, tables
from thinmap_ros.core.slam.graph.keyframes import Keyframe, SavedKeyframes
from thinmap_ros.core.slam.graph.pose_graph import NO_SHARE, Edge, Systematic
from thinmap_ros.core.slam.graph.tables import packed_scans as packed
from thinmap_ros.core.slam.graph.tables import unpacked_scans
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.slam.odometry import UNKNOWN, OdometryCalibration
from thinmap_ros.core.slam.wall_compass import Heading, Reference

POSES = [se2.pose(2.0 + 0.7 * k, 2.0, 0.2 * k) for k in range(4)]
COVARIANCE = np.diag([0.01, 0.02, 0.003])
STEP = np.array([[4e4, 1e3, 5e4], [1e3, 5e4, -2e4], [5e4, -2e4, 9e5]])
STAMP_NS = 1_700_000_000_000_000_000


def frame(k: int, submap: int = 0, scan: Scan | None = None) -> Keyframe:
    scan = scan or scan_in(ROOM, POSES[k], np.random.default_rng(k), STAMP_NS + k)
    heading = Heading(0.2 * k, 1e-4, Reference(1e-5, NO_SHARE)) if k % 2 else None
    return Keyframe(
        scan, surface_points(scan), POSES[k], 0.7 * k, (k + 1) * COVARIANCE, submap, heading
    )


def step(a: int, b: int) -> Edge:
    return Edge(a, b, se2.between(POSES[a], POSES[b]), STEP, False)


def saved(submaps: tuple[int, ...] = (0, 0, 0, 0), **options: object) -> SavedKeyframes:
    """Four keyframes, the third anchored at the first, with a loop edge from the last to it."""
    loop = Edge(3, 0, se2.between(POSES[3], POSES[0]), STEP, True, inlier_ratio=0.9)
    frames = [frame(k, submap) for k, submap in enumerate(submaps)]
    steps = [step(0, 1), step(0, 2), step(2, 3)]
    is_saved = options.get('is_saved', [True] * 4)
    assert isinstance(is_saved, list)
    return SavedKeyframes.of(frames, steps, [loop], is_saved, OdometryCalibration())


def assert_alike(found: Scan, scan: Scan, off_m: float = 0.0005) -> None:
    """The same beams, each to a millimetre and of the same kind."""
    for kind in ('returned', 'without_return', 'below_range_min', 'valid'):
        np.testing.assert_array_equal(getattr(found, kind), getattr(scan, kind))
    off = np.abs(found.ranges_m - scan.ranges_m)[scan.returned]
    assert off.max(initial=0.0) <= off_m + 1e-6
    np.testing.assert_array_equal(found.angles_rad, scan.angles_rad)
    np.testing.assert_array_equal(found.T_base_laser, scan.T_base_laser)
    for name in ('range_min_m', 'range_max_m', 'max_range_m', 'zero_is_no_return', 'drops_out'):
        assert getattr(found, name) == getattr(scan, name)


def test_scans_are_those_of_before_to_a_millimetre() -> None:
    mount = np.array([0.2, -0.1, math.pi])
    nonsense = [math.nan, 0.0, -math.inf, math.inf, -1.0, 0.01, 7.9999, 0.0501, 8.0, 3.1234]
    scans = [
        scan_in(ROOM, POSES[0], np.random.default_rng(1)),
        scan_in(ROOM, POSES[1], np.random.default_rng(2), T_base_laser=mount, clockwise=True),
        Scan.create(5, nonsense, -1.0, 0.2, 0.05, 8.0),
        replace(Scan.create(6, nonsense, -1.0, 0.2, 0.05, 8.0), zero_is_no_return=True),
        replace(Scan.create(7, [2.0], -1.0, 0.2, 0.0, math.inf), max_range_m=12.0, drops_out=True),
    ]
    found = unpacked_scans(packed(scans), 'scans')
    for restored, scan in zip(found, scans, strict=True):
        assert_alike(restored, scan)
    assert [scan.stamp_ns for scan in found] == [1, 2, 3, 4, 5]
    assert len(packed([*scans, *scans])['lasers']) == 5, 'each laser once'


def test_far_ranges_are_rounded_to_two_millimetres() -> None:
    scan = Scan.create(1, [79.9994, 70.1235, 3.1234, 0.0016], 0.0, 0.1, 0.0, 80.0)
    (found,) = unpacked_scans(packed([scan]), 'scans')
    assert_alike(found, scan, 0.001)


def test_what_is_restored_is_what_was_saved() -> None:
    before = saved()
    after = SavedKeyframes.from_state(before.state())
    for one, other in zip(after.frames, before.frames, strict=True):
        assert_alike(one.scan, other.scan)
        np.testing.assert_array_equal(one.T_map_base, other.T_map_base)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6)
        assert one.submap == other.submap and one.path_m == pytest.approx(other.path_m)
        assert (one.heading is None) == (other.heading is None)
        np.testing.assert_array_equal(one.points, surface_points(one.scan))
    heading = after.frames[3].heading
    assert heading is not None and heading.row[:3] == pytest.approx((0.6, 1e-4, 1e-5))
    pairs = zip([*after.steps, *after.edges], [*before.steps, *before.edges], strict=True)
    for edge, other_edge in pairs:
        assert (edge.a, edge.b, edge.robust) == (other_edge.a, other_edge.b, other_edge.robust)
        np.testing.assert_allclose(edge.T_a_b, other_edge.T_a_b, atol=1e-6)
        np.testing.assert_allclose(edge.information, other_edge.information)
    assert after.edges[0].inlier_ratio == pytest.approx(0.9)
    again = after.state()
    for name, array in before.state().items():
        np.testing.assert_array_equal(again[name], array)


def test_a_piece_that_is_apart_is_not_saved_and_a_step_leads_over_it() -> None:
    """The third keyframe is apart: of the step from it to the last nothing is known."""
    found = saved((0, 0, 1, 2), is_saved=[True, True, False, True])
    assert [f.submap for f in SavedKeyframes.from_state(found.state()).frames] == [0, 0, 1]
    assert [(edge.a, edge.b) for edge in found.steps] == [(0, 1), (1, 2)]
    assert [(edge.a, edge.b) for edge in found.edges] == [(2, 0)]
    np.testing.assert_allclose(found.steps[1].information, inverse(UNKNOWN))
    np.testing.assert_array_equal(found.steps[1].T_a_b, se2.between(POSES[1], POSES[3]))


def test_the_uncertainty_of_the_calibration_is_part_of_the_saved_covariances() -> None:
    calibration = OdometryCalibration()
    derivative = np.array([[2.0, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 2.0], [0.0, 1.0, 0.3, 0.0]])
    share = Systematic(derivative, calibration.parameters, 0)
    frames = [replace(frame(k), systematic=k * derivative) for k in range(2)]
    steps = [replace(step(0, 1), systematic=share)]
    found = SavedKeyframes.of(frames, steps, [], [True, True], calibration)
    more = calibration.covariance_of(derivative)
    np.testing.assert_allclose(inverse(found.steps[0].information), inverse(STEP) + more)
    np.testing.assert_allclose(found.frames[1].covariance, frames[1].covariance + more)
    assert not found.frames[1].systematic.any() and found.steps[0].systematic is NO_SHARE


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'beams': np.array([181, 181, 181, 180], np.int32)}, '724 ranges of 723 beams'),
        ({'laser_of': np.array([0, 0, 0, 7], np.int32)}, 'laser_of: 7'),
        ({'step_from': np.array([0, 0, 3], np.int32)}, 'an earlier keyframe each'),
        ({'edges': np.array([[3, 4]], np.int32)}, 'two of the 4 keyframes'),
        ({'edges': np.array([[3, 3]], np.int32)}, 'two of the 4 keyframes'),
        ({'edge_information': np.array([[1.0, 2.0, 0.0, 1.0, 0.0, 1.0]])}, 'positive definite'),
        ({'step_information': np.zeros((3, 6))}, 'step_information: expected positive definite'),
        ({'covariances': np.full((4, 6), 1.0, np.float32) * [1, 3, 0, 1, 0, 1]}, 'covariances'),
        ({'poses': np.full((4, 3), np.nan)}, 'poses'),
    ],
)
def test_what_contradicts_itself_is_refused(changes: dict[str, np.ndarray], reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        SavedKeyframes.from_state({**saved().state(), **changes})


def test_no_more_is_unpacked_than_memory_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    state = saved().state()
    monkeypatch.setattr(tables, 'MAX_BEAMS_IN_ALL', 723)
    with pytest.raises(InputError, match='724 ranges of 724 beams: expected as many, at most 723'):
        SavedKeyframes.from_state(state)
    monkeypatch.undo()
    monkeypatch.setattr(keyframes, 'MAX_KEYFRAMES', 3)
    with pytest.raises(InputError, match='expected 1 to 3 keyframes'):
        SavedKeyframes.from_state(state)
