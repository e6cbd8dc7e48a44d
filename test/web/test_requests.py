"""Requests of pages: the valid ones in full, and no other."""

import json
import random

import pytest
from fuzz.strange_requests import VALID, mutated

from thinmap_ros.core.errors import MAX_QUOTE_LENGTH, InputError
from thinmap_ros.web.requests import MAX_MESSAGE_BYTES, parse


@pytest.mark.parametrize('content', VALID, ids=lambda content: content['action'])
def test_a_valid_request_is_taken(content):
    request = parse(json.dumps(content))
    assert request.action == content['action']
    assert request.values.keys() == content.keys() - {'action'}
    assert parse(json.dumps(content).encode()) == request


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('', 'JSON'),
        ('[' * 10_000, 'JSON'),
        ('[1]', 'JSON object'),
        ('{"action": ["goal"]}', 'expected one of'),
        ('{"action": "shutdown"}', 'expected one of stop'),
        ('{"action": "stop", "force": true}', 'expected none'),
        ('{"action": "goal", "x": 1, "y": 2}', 'expected x, y, theta'),
        ('{"action": "goal", "x": NaN, "y": 2, "theta": 0}', 'x: nan'),
        ('{"action": "goal", "x": 1e999, "y": 2, "theta": 0}', 'x: inf'),
        ('{"action": "goal", "x": true, "y": 2, "theta": 0}', 'x: True'),
        ('{"action": "goal", "x": ' + '9' * 4000 + ', "y": 2, "theta": 0}', 'x: a whole number'),
        ('{"action": "drive", "ahead": 1.01, "left": 0}', 'ahead: 1.01: expected a number from -1'),
        ('{"action": "explore", "area": [[0, 0], [1, 1]], "return_home": true}', '3 to 200'),
        ('{"action": "explore", "area": [[0], [1], [2]], "return_home": true}', r'corner \[x, y\]'),
        ('{"action": "explore", "area": [], "return_home": 1}', 'true or false'),
        ('{"action": "go_to_region", "region": -1}', 'id from 0'),
        ('{"action": "save", "name": "../etc/passwd"}', 'expected a name'),
        ('{"action": "save", "name": "/tmp/x"}', 'expected a name'),
        ('{"action": "save", "name": "a\\n"}', 'expected a name'),
        ('{"action": "save", "name": ""}', 'expected a name'),
    ],
)
def test_another_one_is_refused_in_words(text, said):
    with pytest.raises(InputError, match=said) as refused:
        parse(text)
    assert len(str(refused.value)) < 3 * MAX_QUOTE_LENGTH and '\n' not in str(refused.value)


def test_a_long_message_is_not_read():
    with pytest.raises(InputError, match='bytes: expected at most'):
        parse(' ' * (MAX_MESSAGE_BYTES + 1))


def test_no_strange_message_gets_through_or_raises_anything_else():
    rng = random.Random(5)
    for _ in range(3000):
        with pytest.raises(InputError):
            parse(mutated(rng))


def test_bytes_that_are_no_text_are_refused():
    with pytest.raises(InputError, match='JSON'):
        parse(b'\xff\xfe{')
