"""The stage of the map."""

import numpy as np
import pytest
from support.slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.mapper import Mapper
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyConfig
from thinmap_ros.core.stage import Destination, LocalizedScan, Trajectory

POSES = [se2.pose(2.0 + 0.3 * k, 2.0, 0.0) for k in range(8)]


def localized(k, T_map_base, trajectory=None):
    scan = scan_in(ROOM, POSES[k], None, k + 1)
    return LocalizedScan(scan, T_map_base, Destination.MAP, trajectory)


def corrected(mapper):
    """Map four scans 0.5 m off, correct them, and add others until the map is complete."""
    for k in range(4):
        mapper.step(localized(k, POSES[k] + [0.5, 0.0, 0.0]))
    trajectory = Trajectory(np.arange(1, 5), np.array(POSES[:4]), 5)
    return [mapper.step(localized(k, POSES[k], trajectory if k == 4 else None)) for k in (4, 5)]


def test_an_update_has_the_whole_map_once_all_of_it_is_corrected():
    begun, complete = corrected(Mapper(PAPER_GRID))
    assert begun.is_rerendering and begun.whole is None and begun.corrected_ns == 0
    assert not complete.is_rerendering and complete.corrected_ns == 5
    whole = complete.whole
    assert (whole.corrected_ns, whole.previous_ns) == (5, 0)
    by = whole.moved.before - whole.moved.after
    np.testing.assert_allclose(by, [[0.5, 0.0, 0.0]] * 5)


def test_a_correction_is_completed_at_the_end_and_described_as_long_as_it_is_the_newest():
    mapper = Mapper(PAPER_GRID)
    for k in range(4):
        mapper.step(localized(k, POSES[k]))
    assert mapper.correct(Trajectory(np.arange(1, 5), np.array(POSES[:4]), 5))
    whole = mapper.finish()
    assert whole.corrected_ns == 5 and len(whole.moved.after) == 4
    assert mapper.finish() is None
    mapper.step(localized(4, POSES[4]))
    assert len(mapper.whole_map().moved.after) == 4


def test_updates_come_with_every_nth_scan_and_show_what_has_changed_since_the_last():
    mapper = Mapper(PAPER_GRID, scans_per_update=3)
    updates = [mapper.step(localized(k, POSES[k])) for k in range(7)]
    assert [update is not None for update in updates] == [True, False, False] * 2 + [True]
    assert Mapper(PAPER_GRID, window_m=4.0).step(localized(0, POSES[0])).changes.shape == (40, 40)


def added_only(mapper, other):
    """Map four scans off, correct them and four more, twice; update the other with each scan."""
    off = [0.5, 0.0, 0.0]
    corrections = {4: (POSES, 5), 6: ([T + [0.0, 0.2, 0.0] for T in POSES], 7)}
    place = [T + off for T in POSES]
    for k in range(8):
        trajectory = None
        if k in corrections:
            place, since_ns = corrections[k]
            trajectory = Trajectory(np.arange(1, k + 1), np.array(place[:k]), since_ns)
        assert mapper.add(localized(k, place[k], trajectory))
        yield other.step(localized(k, place[k], trajectory))


def test_an_update_that_is_made_later_tells_all_corrections_since_the_last_as_one():
    mapper = Mapper(PAPER_GRID)
    other = Mapper(PAPER_GRID)
    assert not mapper.has_changed
    updates = list(added_only(mapper, other))
    assert mapper.has_changed
    late = mapper.update()
    assert not mapper.has_changed
    assert (late.whole.previous_ns, late.whole.corrected_ns) == (0, 7)
    assert [update.whole.corrected_ns for update in updates if update.whole] == [5, 7]
    by = late.whole.moved.after - late.whole.moved.before
    np.testing.assert_allclose(by, [[-0.5, 0.2, 0.0]] * len(by), atol=1e-9)
    # Every place where the map was not being corrected, in the corrected map.
    by_x = [T[0] for T in POSES[:4]]
    np.testing.assert_allclose(late.places[:4, 0], by_x, atol=1e-9)
    np.testing.assert_allclose(late.places[:4, 1], 2.2, atol=1e-9)
    np.testing.assert_array_equal(late.changes.cells, other.whole_map().patch.cells)


def test_a_saved_map_is_continued_and_not_corrected():
    mapper = Mapper(PAPER_GRID)
    mapper.step(localized(0, POSES[0]))
    other = Mapper(PAPER_GRID)
    other.restore(mapper.state())
    patches = [each.whole_map().patch for each in (mapper, other)]
    np.testing.assert_array_equal(patches[0].cells, patches[1].cells)
    assert not other.correct(Trajectory(np.arange(1, 2), np.array(POSES[:1]), 5))
    assert other.whole_map().corrected_ns == 5
    with pytest.raises(InputError, match='resolution_m'):
        Mapper(OccupancyConfig(resolution_m=0.05)).restore(mapper.state())
