"""Of two publishers of a topic, the first is followed until it ends, whatever their numbers."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.ros.sole_source import SoleSource

S = 10**9


def stream(name, rate_hz, start_s, end_s, number=1, seed=0, loss=0.0):
    """Messages of a publisher with jitter and later losses: (time of receipt, number, name)."""
    chance = random.Random(f'{name} {seed}')
    count = int((end_s - start_s) * rate_hz)
    times = [start_s + (k + chance.uniform(0.0, 0.1)) / rate_hz for k in range(count)]
    sent = [(time_s, number + k, name) for k, time_s in enumerate(times)]
    return sent[:5] + [message for message in sent[5:] if chance.random() >= loss]


def accepted(*streams, publishers=None):
    """Times and names of the messages that are accepted, in the order of their receipt."""
    source = SoleSource(lambda: publishers or len(streams))
    messages = sorted(message for each in streams for message in each)
    return [
        (time_s, name)
        for time_s, number, name in messages
        if source.accepts(
            {'publication_sequence_number': number, 'received_timestamp': round(S * time_s)}
        )
    ]


@given(
    st.sampled_from([5.0, 12.0, 40.0]),
    st.sampled_from([5.0, 12.0, 40.0]),
    st.integers(1, 60),
    st.sampled_from([0.0, 0.1]),
    st.integers(0, 9),
)
def test_a_second_publisher_is_refused_whatever_its_rate(first_hz, second_hz, number, loss, seed):
    first = stream('first', first_hz, 0.0, 40.0, number, seed, loss)
    second = stream('second', second_hz, 1.03, 40.0, 1, seed, loss)
    found = [name for _, name in accepted(first, second)]
    # Where the numbers of both are equal, one message may be taken for one of the other.
    assert found.count('second') <= 1 and found.count('first') >= len(first) - 1


def test_two_publishers_with_the_same_numbers_are_told_apart_by_their_times():
    first = stream('first', 5.0, 0.0, 60.0, loss=0.2)
    second = stream('second', 5.0, 0.08, 60.0, loss=0.2)
    assert {name for _, name in accepted(first, second)} == {'first'}


def test_the_second_is_followed_three_seconds_after_the_last_of_the_first():
    first = stream('first', 10.0, 0.0, 10.0)
    second = stream('second', 10.0, 5.0, 30.0)
    found = accepted(first, second)
    assert [name for time_s, name in found if time_s < 12.9] == ['first'] * 100
    assert {name for time_s, name in found if time_s > 13.1} == {'second'}
    back = stream('first', 10.0, 20.0, 30.0)
    assert accepted(first, second, back) == found


def test_a_restarted_publisher_that_is_alone_is_followed_at_once():
    first = stream('first', 10.0, 0.0, 10.0, number=300)
    again = stream('again', 10.0, 10.5, 20.0)
    assert len(accepted(first, again, publishers=1)) == len(first + again)


def test_the_queued_messages_of_a_second_publisher_that_has_ended_are_refused():
    publishers = [2]
    source = SoleSource(lambda: publishers[0], now_ns=lambda: round(10.5 * S))
    messages = [*stream('first', 10.0, 0.0, 10.0), *stream('second', 10.0, 2.0, 9.9)]

    def accepts(time_s, number):
        info = {'publication_sequence_number': number, 'received_timestamp': round(S * time_s)}
        return source.accepts(info)

    for time_s, number, _ in sorted(messages):
        accepts(time_s, number)
    publishers[0] = 1
    assert not accepts(10.0, 80)
    assert not accepts(10.1, 81)
    assert accepts(10.15, 101)
    # The other one has ended: what continues is the one that is left.
    assert accepts(10.6, 86)


@pytest.mark.parametrize('jump_s', [-3600.0, 3600.0])
def test_a_clock_of_the_machine_that_is_set_does_not_stop_the_stream(jump_s):
    first = stream('first', 10.0, 5000.0, 5010.0)
    then = stream('first', 10.0, 5010.0 + jump_s, 5020.0 + jump_s, number=len(first) + 1)
    source = SoleSource(lambda: 2)
    answers = [
        source.accepts({'publication_sequence_number': n, 'received_timestamp': round(S * time_s)})
        for time_s, n, _ in first + then
    ]
    assert all(answers)


def test_a_middleware_without_numbers_has_all_accepted():
    source = SoleSource(lambda: 2)
    assert all(source.accepts({'publication_sequence_number': None}) for _ in range(3))
