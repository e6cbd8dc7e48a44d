"""Names stay at their rooms: through splits, corrections and a saved state."""

import numpy as np
import pytest
from core.topology.floors import office, patch_of

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.moved import MapMotion
from thinmap_ros.core.topology import regions as region_names
from thinmap_ros.core.topology.regions import MAX_LENGTH, RegionMap, RegionNames, checked_name
from thinmap_ros.core.topology.segmentation import RegionTracker

LEFT = np.array([3.0, 7.0])
RIGHT = np.array([11.0, 7.0])


def id_at(regions: RegionMap, place: np.ndarray) -> int:
    return int(regions.ids_at(place[None])[0])


def name_at(names: RegionNames, regions: RegionMap, place: np.ndarray) -> str:
    return names.named(regions).regions[id_at(regions, place)].name


def give(tracker: RegionTracker, place: np.ndarray, name: str) -> None:
    assert tracker.regions is not None
    tracker.names.put(tracker.regions, id_at(tracker.regions, place), place, name)


@pytest.fixture
def tracker() -> RegionTracker:
    made = RegionTracker()
    made.update(patch_of(office()))
    give(made, LEFT, 'Küche')
    return made


def test_a_region_has_one_name_until_it_is_removed(tracker: RegionTracker) -> None:
    regions = tracker.regions
    assert regions is not None and {r.name for r in regions.regions.values()} == {''}
    give(tracker, RIGHT, 'office of Ann')
    give(tracker, LEFT + 1.0, 'kitchen')
    assert name_at(tracker.names, regions, LEFT) == 'kitchen'
    assert name_at(tracker.names, regions, RIGHT) == 'office of Ann'
    give(tracker, LEFT, '')
    assert name_at(tracker.names, regions, LEFT) == ''
    assert name_at(tracker.names, regions, RIGHT) == 'office of Ann'


def test_a_name_stays_with_the_part_of_a_room_in_which_it_was_given(tracker: RegionTracker) -> None:
    before = id_at(tracker.update(patch_of(office())), LEFT)
    cells = office()
    cells[23:73, 32] = 100  # a wall 1 m left of the name: a small part keeps it, not the id
    cells[23:73, 46:80] = 0
    cells[22, 34:40] = 0
    cells[23:73, 45] = 100
    cells[40:50, 45] = 0
    for _ in range(8):
        regions = tracker.update(patch_of(cells))
    assert id_at(regions, LEFT) != before
    named = tracker.names.named(regions).regions.values()
    assert [region.id for region in named if region.name] == [id_at(regions, LEFT)]


def test_a_name_moves_with_a_correction_of_its_room(tracker: RegionTracker) -> None:
    moved = tracker.update(patch_of(office(), (19.0, -8.0)))
    assert not any(region.name for region in tracker.names.named(moved).regions.values())
    before = np.array([[3.0, 3.0, 0.0], [11.0, 3.0, 0.0]])
    tracker.names.move(MapMotion(before, before + [20.0, -10.0, 0.0]))
    assert name_at(tracker.names, moved, LEFT + [20.0, -10.0]) == 'Küche'


def test_names_are_part_of_a_saved_state_and_missing_in_earlier_ones(
    tracker: RegionTracker,
) -> None:
    state = tracker.state()
    restored = RegionTracker.from_state(state)
    assert name_at(restored.names, restored.update(patch_of(office())), LEFT) == 'Küche'
    earlier = {name: state[name] for name in state if name not in region_names.FIELDS}
    nameless = RegionTracker.from_state(earlier)
    assert name_at(nameless.names, nameless.update(patch_of(office())), LEFT) == ''


def test_a_name_that_cannot_be_shown_is_refused(tracker: RegionTracker) -> None:
    assert checked_name('  the hall ') == 'the hall'
    for wrong in ('x' * (MAX_LENGTH + 1), 'a\nb', 'a\x00', '\ud800'):
        with pytest.raises(InputError, match='expected at most 64 characters'):
            checked_name(wrong)
    state = tracker.names.state()
    for letters in (0, 10, 0xD800):
        wrong_letters = state['name_letters'].copy()
        wrong_letters[0, :6] = letters
        with pytest.raises(InputError, match='name'):
            RegionNames.from_state({**state, 'name_letters': wrong_letters})
    with pytest.raises(InputError, match='no name_letters'):
        RegionTracker.from_state(
            {name: array for name, array in tracker.state().items() if name != 'name_letters'}
        )


def test_the_number_of_names_is_bounded(
    tracker: RegionTracker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(region_names, 'MAX_NAMES', 1)
    give(tracker, LEFT, 'another one')
    with pytest.raises(InputError, match='at most 1 names'):
        give(tracker, RIGHT, 'one too many')
    regions = tracker.regions
    assert regions is not None and name_at(tracker.names, regions, LEFT) == 'another one'
