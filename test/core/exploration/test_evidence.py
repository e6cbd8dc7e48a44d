"""Evidence: which frontier is which place, and how long tries are remembered."""

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.belief import FIELDS, EvidenceStore, completed
from thinmap_ros.core.snapshot import validate

CELL_M = 0.1


def line(first, count=20, row=100):
    """Cells of a straight frontier."""
    return np.column_stack([np.full(count, row), np.arange(first, first + count)])


def followed(store, *frontiers):
    return store.follow([(0.1 * f[0, 1], 0.1 * f[0, 0]) for f in frontiers], frontiers, CELL_M)


def test_a_frontier_that_moves_a_little_is_the_same_place_and_one_that_moves_on_is_another():
    store = EvidenceStore(1)
    (evidence,) = followed(store, line(0))
    assert followed(store, line(0, row=104)) == [evidence]
    assert followed(store, line(8, row=104)) == [evidence]
    (other,) = followed(store, line(8, row=111))
    assert other is not evidence and other.id == 2
    assert followed(store) == []
    assert followed(store, line(8, row=111)) != [other], 'it was not tried'


def test_what_was_tried_is_the_same_place_until_half_of_its_frontier_has_changed():
    store = EvidenceStore(1)
    (visited,) = followed(store, line(0))
    visited.visits = 1
    assert followed(store) == []
    assert followed(store, line(0, 6)) == [visited], 'the rest of its frontier'
    assert followed(store, line(6)) == [visited]
    assert followed(store, line(0, 30)) == [visited]
    # It is compared with the frontier of the try: many small changes make another place.
    (other,) = followed(store, line(0, 60))
    assert other.visits == 0
    assert followed(store, line(0)) == [visited]


def test_both_parts_of_what_was_tried_are_tried():
    store = EvidenceStore(1)
    (evidence,) = followed(store, line(0))
    evidence.failures = 2
    evidence.failed_ns = 7
    left, right = followed(store, line(0, 8), line(12, 8))
    assert left is evidence and right.id == 2
    assert (right.failures, right.failed_ns) == (2, 7)


def test_of_two_frontiers_side_by_side_each_keeps_its_own_evidence():
    store = EvidenceStore(1)
    first, second = followed(store, line(0), line(40))
    assert followed(store, line(43), line(2)) == [second, first]


def test_a_store_continues_from_its_state():
    store = EvidenceStore(1)
    near, far = followed(store, line(0), line(60, 7))
    near.add_visit((0.5, 9.0))
    near.add_visit((0.5, 8.0))
    far.add_visit((6.0, 9.0))
    near.visits = 3
    near.failures = 1
    again = EvidenceStore(1)
    again.restore(validate(store.state(), FIELDS, 'exploration'))
    kept, moved = again.items
    assert (kept.id, kept.place, kept.visits, kept.failures) == (1, (0.0, 10.0), 3, 0)
    assert (moved.cells == far.cells).all()
    assert kept.seen_from == ((0.5, 9.0), (0.5, 8.0)) and moved.seen_from == ((6.0, 9.0),)
    assert [item.id for item in followed(again, line(0), line(60, 7), line(90))] == [1, 2, 3]
    again.restore(validate(EvidenceStore(1).state(), FIELDS, 'exploration'))
    assert again.items == []


def test_a_state_of_an_earlier_release_has_no_places_of_visits():
    store = EvidenceStore(1)
    for evidence in followed(store, line(0), line(60)):
        evidence.add_visit((1.0, 9.0))
    state = store.state()
    del state['seen_from'], state['seen_counts']
    store.restore(validate(completed(state), FIELDS, 'exploration'))
    assert [(item.visits, item.seen_from) for item in store.items] == [(1, ()), (1, ())]


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('cell_counts', [1, 1]),
        ('seen_counts', [1, 1]),
        ('cell_counts', [2**62, 2**62]),
        ('ids', [1, 1]),
    ],
)
def test_a_state_that_contradicts_itself_is_refused(name, value):
    store = EvidenceStore(1)
    followed(store, line(0), line(60))
    state = store.state() | {name: np.array(value)}
    with pytest.raises(InputError, match='saved exploration'):
        EvidenceStore(1).restore(validate(state, FIELDS, 'exploration'))
