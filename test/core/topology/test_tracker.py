"""Ids of regions while the map grows, at splits and merges, and through a saved state."""

import numpy as np
import pytest
from core.topology.floors import CELL_M, office, patch_of

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.topology.segmentation import RegionTracker

CORRIDOR = (7.0, 3.2)
LEFT = (3.0, 7.0)
RIGHT = (11.0, 7.0)
MANY = 8  # updates, after which every cell has forgotten its earlier id


def ids(tracker: RegionTracker, cells: np.ndarray, *points: tuple[float, float]) -> list[int]:
    found: list[int] = tracker.update(patch_of(cells)).ids_at(np.array(points)).tolist()
    return found


def divided() -> np.ndarray:
    """The office with a wall through the left room: 5 m of it remain on the left, 2.7 m right."""
    cells = office()
    cells[23:73, 52] = 100
    cells[22, 60:70] = 0
    return cells


def test_ids_stay_while_the_map_grows_in_all_directions() -> None:
    tracker = RegionTracker()
    whole = office()
    seen: dict[tuple[float, float], int] = {}
    for reach in range(20, 90, 10):
        low = max(75 - reach, 0)
        part = whole[:, low : 75 + reach]
        frame = GridFrame(-1.0 + low * CELL_M, 2.0, CELL_M)
        found = tracker.update(GridPatch(frame, np.ascontiguousarray(part)))
        for place in (CORRIDOR, (6.3, 7.0), (7.6, 7.0)):
            number = int(found.ids_at(np.array([place]))[0])
            assert number > 0
            assert seen.setdefault(place, number) == number
    assert len(set(seen.values())) == 3


def test_the_larger_part_keeps_the_id_at_a_split_and_no_id_is_reused() -> None:
    tracker = RegionTracker()
    before = ids(tracker, office(), LEFT, RIGHT, CORRIDOR)
    for _ in range(MANY):
        after = ids(tracker, divided(), (1.0, 7.0), RIGHT, CORRIDOR, (6.0, 7.0))
    assert after[:3] == before
    assert after[3] > max(before)


def test_the_larger_region_keeps_its_id_at_a_merge() -> None:
    tracker = RegionTracker()
    before = ids(tracker, divided(), (1.0, 7.0), (6.0, 7.0))
    for _ in range(MANY):
        merged = ids(tracker, office(), (1.0, 7.0), (6.0, 7.0))
    assert merged == [before[0], before[0]]
    for _ in range(MANY):
        again = ids(tracker, divided(), (1.0, 7.0), (6.0, 7.0))
    assert again[0] == before[0]
    assert again[1] > max(before)


def test_a_region_that_was_merged_for_a_moment_has_its_id_again() -> None:
    tracker = RegionTracker()
    before = ids(tracker, divided(), (1.0, 7.0), (6.0, 7.0))
    tracker.update(patch_of(office()))
    assert ids(tracker, divided(), (1.0, 7.0), (6.0, 7.0)) == before


def test_an_unseen_room_is_no_region() -> None:
    cells = office()
    cells[23:73, 82:162] = UNKNOWN
    assert len(RegionTracker().update(patch_of(cells)).regions) == 2


def test_a_state_continues_with_the_same_ids() -> None:
    tracker = RegionTracker()
    tracker.update(patch_of(office()))
    before = ids(tracker, divided(), LEFT, RIGHT, CORRIDOR, (6.0, 7.0))
    restored = RegionTracker.from_state(tracker.state())
    assert ids(restored, divided(), LEFT, RIGHT, CORRIDOR, (6.0, 7.0)) == before
    skipped = RegionTracker.from_state(tracker.state())
    skipped.skip_ids(100)
    moved = GridPatch(GridFrame(500.0, 500.0, CELL_M), office())
    assert min(skipped.update(moved).regions) > max(before) + 100
    assert RegionTracker().state() == {}
    assert RegionTracker.from_state({}).regions is None


def test_a_damaged_state_is_refused() -> None:
    tracker = RegionTracker()
    tracker.update(patch_of(office()))
    state = tracker.state()
    with pytest.raises(InputError, match='saved regions: id 3: expected ids below 2'):
        RegionTracker.from_state({**state, 'next_region_id': np.array(2)})
    with pytest.raises(InputError, match='no region_frame'):
        RegionTracker.from_state({'region_labels': state['region_labels']})
    with pytest.raises(InputError, match='cells of 0 m'):
        RegionTracker.from_state({**state, 'region_frame': np.zeros(3)})
