"""Merging and searching take turns, however long each lasts, and whatever becomes of it."""

import pytest

from thinmap_ros.nodes.parts.joining import Turns, Worker


def test_kinds_that_are_always_ready_take_turns():
    turns = Turns()
    taken = [turns.take(['merge', 'search']) for _ in range(4)]
    assert taken == ['merge', 'search', 'merge', 'search']


def test_a_kind_that_is_ready_alone_does_not_wait():
    turns = Turns()
    assert [turns.take(['merge']) for _ in range(3)] == ['merge'] * 3
    assert turns.take([]) == ''
    assert turns.take(['merge', 'search']) == 'merge'


def test_work_that_fails_says_so_once_and_other_work_may_begin():
    def fail():
        raise ZeroDivisionError('planted')

    worker = Worker(1.0)
    worker.begin(fail)
    with pytest.raises(ZeroDivisionError):
        while not worker.is_free:
            worker.take_result()
    worker.take_result()
    taken = []
    worker.begin(lambda: lambda: taken.append('other'))
    while not taken:
        worker.take_result()
