"""Requests of pages: the valid ones in full, and no other."""

import json
import random

import pytest
from fuzz.strange_requests import VALID, mutated

from thinmap_ros.core.errors import MAX_QUOTE_LENGTH, InputError
from thinmap_ros.web import requests
from thinmap_ros.web.requests import MAX_MESSAGE_BYTES, parse


@pytest.mark.parametrize('content', VALID, ids=lambda content: content['action'])
def test_a_valid_request_is_taken(content):
    request = parse(json.dumps(content))
    assert request.action == content['action']
    assert request.values.keys() == content.keys() - {'action', 'beat'}
    assert request.beat == content.get('beat')
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
        ('{"action": "drive", "ahead": 1, "left": 0}', 'drive: no beat: expected the newest'),
        ('{"action": "home"}', 'home: no beat: expected the newest'),
        ('{"action": "stop", "beat": -1}', 'beat: -1: expected a number of milliseconds'),
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


@pytest.mark.parametrize(
    ('action', 'limit_s'),
    [
        ({'action': 'drive', 'ahead': 0.1, 'left': 0.0}, 0.5),
        ({'action': 'goal', 'x': 1, 'y': 2, 'theta': 0}, 2.0),
        ({'action': 'go_to_region', 'region': 1}, 2.0),
        ({'action': 'home'}, 2.0),
        ({'action': 'explore', 'area': [], 'return_home': False}, 2.0),
        ({'action': 'resume'}, 2.0),
        ({'action': 'release', 'stop': 1}, 2.0),
        ({'action': 'initial_pose', 'x': 1, 'y': 2, 'theta': 0}, 2.0),
    ],
    ids=lambda value: value['action'] if isinstance(value, dict) else '',
)
def test_what_moves_the_robot_is_done_in_time_or_not_at_all(action, limit_s, monkeypatch):
    monkeypatch.setattr(requests, 'monotonic', lambda: 100.0)
    request = parse(json.dumps({**action, 'beat': requests.beat()}))
    for age_s in (0.0, 0.15, limit_s):
        monkeypatch.setattr(requests, 'monotonic', lambda age_s=age_s: 100.0 + age_s)
        request.require_recent()
    # As long as nothing of the server has run, too: the beat is a time, and no count.
    for age_s in (limit_s + 0.01, 3.0, 4.5, 1e6):
        monkeypatch.setattr(requests, 'monotonic', lambda age_s=age_s: 100.0 + age_s)
        with pytest.raises(InputError, match=f'the link is {age_s:.1f} s late'):
            request.require_recent()
    # The machine was started again, or the page invents beats.
    monkeypatch.setattr(requests, 'monotonic', lambda: 99.0)
    with pytest.raises(InputError, match='beat 100000: expected one that was sent'):
        request.require_recent()


@pytest.mark.parametrize(
    'action',
    [
        {'action': 'stop'},
        {'action': 'cancel'},
        {'action': 'pause'},
        {'action': 'drive', 'ahead': 0.0, 'left': 0},
    ],
    ids=lambda action: action['action'],
)
@pytest.mark.parametrize('beat', [{}, {'beat': 0}, {'beat': 2**53}])
def test_what_stops_the_robot_is_never_too_late(action, beat):
    parse(json.dumps({**action, **beat})).require_recent()
