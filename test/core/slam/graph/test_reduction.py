"""Keyframes go of which later visits show the place as well; the graph of the others is honest."""

from dataclasses import replace

import numpy as np
import pytest
from support.laps import LOOP, WAY, driven, keyframe
from support.slam_room import ROOM

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import SavedKeyframes
from thinmap_ros.core.slam.graph.pose_graph import EdgeArrays, _linearise
from thinmap_ros.core.slam.graph.reduction import needed, reduced


def covariance_of(saved: SavedKeyframes, place: Array) -> Array:
    """Covariance (3, 3) of the keyframe at a pose (3,), by all edges at once."""
    poses = np.array([frame.T_map_base for frame in saved.frames])
    arrays = EdgeArrays.of([*saved.steps, *saved.edges])
    _, by_a, by_b = _linearise(poses, arrays.a, arrays.b, arrays.T_a_b)
    H = np.zeros((len(poses), 3, len(poses), 3))
    for a, b, J, K, W in zip(arrays.a, arrays.b, by_a, by_b, arrays.information, strict=True):
        for i, left in ((a, J), (b, K)):
            for j, right in ((a, J), (b, K)):
                H[i, :, j] += left.T @ W @ right
    whole = H.reshape(3 * len(poses), -1)[3:, 3:]
    k = int(np.argmin(np.abs(poses - place).sum(axis=1)))
    return np.asarray(np.linalg.inv(whole)[3 * k - 3 : 3 * k, 3 * k - 3 : 3 * k], dtype=np.float64)


def test_a_way_that_is_driven_each_day_does_not_grow() -> None:
    counts = [len(reduced(driven(laps)).frames) for laps in (1, 2, 3, 4)]
    assert counts[0] == len(WAY), 'what no later visit shows stays'
    assert counts[-1] <= 1.2 * counts[0] + 4  # a start for each day, and the first of all
    assert counts[-1] - counts[-2] <= 1


def test_a_single_keyframe_stays() -> None:
    before = driven(1)
    one = replace(before, frames=before.frames[:1], steps=[], edges=[])
    assert len(reduced(one).frames) == 1


def test_the_newest_stay_with_their_poses_covariances_and_stamps() -> None:
    before = driven(3)
    after = reduced(before)
    assert [frame.scan.stamp_ns for frame in after.frames] == list(range(1, len(after.frames) + 1))
    numbers = [stamp_ns - 10 for stamp_ns in after.stamps_ns]
    assert numbers[0] == 0 and set(range(2 * len(WAY), 3 * len(WAY))) <= set(numbers)
    for number, frame in zip(numbers, after.frames, strict=True):
        np.testing.assert_array_equal(frame.T_map_base, before.frames[number].T_map_base)
        np.testing.assert_array_equal(frame.covariance, before.frames[number].covariance)
        assert frame.points is before.frames[number].points


def test_a_place_that_is_hidden_today_keeps_its_keyframes() -> None:
    """A door that was open once: what was seen through it stays known."""
    shut = np.vstack([ROOM, [[4.5, 0.0, 4.5, 5.0]]])
    counts = []
    for walls in (ROOM, shut):
        first = driven(1).frames
        today = [keyframe(f.T_map_base, 30.0 + f.path_m, walls) for f in first[:5]]
        counts.append(int(needed([*first, *today])[:5].sum()))
    assert counts[0] == 1, 'the first'
    assert counts[1] == 5


def test_what_is_left_says_no_more_than_all_did() -> None:
    before = driven(3)
    after = reduced(before)
    assert len(after.frames) < 0.6 * len(before.frames)
    for frame in after.frames[2::3]:
        full = covariance_of(before, frame.T_map_base)
        less = covariance_of(after, frame.T_map_base)
        sigmas = np.sqrt(np.linalg.eigvals(np.linalg.solve(full, less)).real)
        assert sigmas.min() > 0.95, 'never surer'
        assert sigmas.max() < 2.0, 'and not much less sure'


def test_edges_lead_from_earlier_keyframes_and_agree_with_the_poses() -> None:
    after = reduced(driven(4))
    restored = SavedKeyframes.from_state(after.state())
    assert len(restored.edges) >= len(WAY) and len(restored.steps) == len(after.frames) - 1
    poses = [frame.T_map_base for frame in after.frames]
    for edge in after.edges:
        off = se2.pose_difference(edge.T_a_b, se2.between(poses[edge.a], poses[edge.b]))
        assert float(off @ edge.information @ off) < 16.3  # 99.9 %


def test_edges_of_which_one_is_false_are_not_averaged() -> None:
    before = driven(2)
    count = len(WAY)
    false = replace(before.edges[5], T_a_b=before.edges[5].T_a_b + (3.0, 0.0, 0.0))
    sure = [replace(edge, information=4.0 * LOOP) for edge in before.edges]
    poses = [frame.T_map_base for frame in before.frames]
    after = reduced(replace(before, edges=[*sure, false]))
    assert len(after.frames) < count + 5
    kept = [frame.T_map_base for frame in after.frames]
    off_m = [
        np.hypot(*(edge.T_a_b - se2.between(kept[edge.a], kept[edge.b]))[:2])
        for edge in after.edges
    ]
    assert max(off_m) < 0.5 and len(poses) == 2 * count


@pytest.mark.parametrize('laps', [1, 2])
def test_a_reduced_graph_is_not_reduced_again(laps: int) -> None:
    once = reduced(driven(laps))
    assert len(reduced(once).frames) == len(once.frames)
