"""A page receives what has changed since it last received anything, and nothing else."""

import json

import pytest

from thinmap_ros.web.pages import Board


def sent(board, change):
    last, text = board.since(change)
    return last, dict(json.loads(text)) if text else {}


def test_a_new_page_gets_all_and_then_what_changes():
    board = Board()
    board.put('a', 1)
    board.put('b', [2, 'x'])
    change, items = sent(board, 0)
    assert items == {'a': 1, 'b': [2, 'x']}
    assert sent(board, change) == (change, {})
    board.put('a', 1)  # as before
    assert sent(board, change) == (change, {})
    board.put('a', 3)
    change, items = sent(board, change)
    assert items == {'a': 3}


def test_items_come_in_the_order_of_their_changes():
    board = Board()
    board.put('map', 1)
    board.put('tile/0/0', 'old')
    board.put('map', 2)
    board.put('tile/0/0', 'new')
    assert [name for name, _ in json.loads(board.since(0)[1])] == ['map', 'tile/0/0']


def test_removed_items_are_not_sent_to_new_pages():
    board = Board()
    board.put('edge/1', 1)
    board.put('edge/2', 2)
    board.put('graph', 0)
    board.keep('edge/', {'edge/2'})
    assert sent(board, 0)[1] == {'edge/2': 2, 'graph': 0}


def test_a_number_that_json_does_not_have_is_an_error_here():
    with pytest.raises(ValueError, match='JSON'):
        Board().put('a', float('nan'))
