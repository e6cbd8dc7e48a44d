"""Merging and searching take turns, however long each lasts."""

from thinmap_ros.nodes.joining.worker import Turns


def test_kinds_that_are_always_ready_take_turns():
    turns = Turns()
    taken = [turns.take(['merge', 'search']) for _ in range(4)]
    assert taken == ['merge', 'search', 'merge', 'search']


def test_a_kind_that_is_ready_alone_does_not_wait():
    turns = Turns()
    assert [turns.take(['merge']) for _ in range(3)] == ['merge'] * 3
    assert turns.take([]) == ''
    assert turns.take(['merge', 'search']) == 'merge'
