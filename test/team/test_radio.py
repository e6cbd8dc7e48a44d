"""Messages between robots: late, lost, or never sent."""

from thinmap_ros.closed_loop.radio import Radio, Trouble


def radio(robots=3, delay_s=0.0, **trouble):
    return Radio(robots, Trouble(**trouble), delay_s, 0)


def test_all_others_receive_a_message_once():
    air = radio()
    air.broadcast(1, 'hello', 100, 0.0)
    assert list(air.received(0.0)) == [(0, 'hello'), (2, 'hello')]
    assert list(air.received(1.0)) == []
    assert air.sent_bytes == 100


def test_a_message_arrives_after_its_delay():
    air = radio(2, delay_s=5.0)
    air.broadcast(0, 'late', 1, 10.0)
    assert list(air.received(14.9)) == []
    assert list(air.received(15.0)) == [(1, 'late')]


def test_a_robot_out_of_reach_neither_sends_nor_receives():
    air = radio(3, out_of_reach=(1, 60.0, 60.0))
    air.broadcast(1, 'unsent', 1, 60.0)
    air.broadcast(0, 'heard by one', 1, 60.0)
    assert list(air.received(60.0)) == [(2, 'heard by one')]
    air.broadcast(1, 'back', 1, 120.0)
    assert list(air.received(120.0)) == [(0, 'back'), (2, 'back')]


def test_a_dead_robot_is_silent_for_good():
    trouble = Trouble(dead=(0, 60.0))
    assert not trouble.is_dead(0, 59.9)
    assert trouble.is_dead(0, 60.0) and trouble.is_silent(0, 1e6)
    assert not trouble.is_silent(1, 60.0)


def test_a_share_of_messages_is_lost():
    air = radio(2, loss=0.3)
    for number in range(1000):
        air.broadcast(0, number, 1, 0.0)
    assert 650 < len(list(air.received(0.0))) < 750
