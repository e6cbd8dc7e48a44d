"""Lost messages of a stream.

Distinguished from pauses, and from two publishers in turn.
"""

from thinmap_ros.ros.subscription import MessageLossCounter

STEP_NS = 200_000_000


def counted(came, is_sole=False):
    """Sums of lost and missing messages over received (time in steps, number)."""
    losses = MessageLossCounter(is_sole)
    found = [losses.record(10**12 + steps * STEP_NS, number) for steps, number in came]
    return sum(lost for lost, _ in found), sum(missing for _, missing in found)


def test_what_comes_one_after_the_other_is_all():
    assert counted([(i, i + 7) for i in range(20)]) == (0, 0)


def test_what_was_sent_and_did_not_come_is_lost_however_long_the_gap():
    assert counted([(0, 1), (1, 2), (2, 3), (6, 7), (7, 8), (507, 508)]) == (3 + 499, 0)


def test_what_was_never_sent_is_missing_unless_the_sensor_was_silent():
    assert counted([(0, 1), (1, 2), (4, 3), (7, 5), (107, 6)]) == (1, 2 + 1)


def test_without_sequence_numbers_losses_follow_from_stamps():
    assert counted([(0, None), (1, None), (4, None), (104, None)]) == (0, 2)


def test_two_publishers_in_turn_have_lost_nothing():
    assert counted([(i, 900 + i // 2 if i % 2 else i // 2) for i in range(40)]) == (0, 0)


def test_a_restarted_publisher_or_clock_counts_no_losses():
    assert counted([(0, 500), (1, 501), (2, 1), (3, 2), (-400, 3), (-399, 4)]) == (0, 0)


def test_what_a_sole_publisher_skips_is_lost_even_if_stamps_repeat_or_go_back():
    came = [(0, 1), (1, 2), (2, 3), (-400, 5), (-399, 6), (-399, 9), (-800, 900), (-900, 7)]
    assert counted(came, is_sole=True) == (1 + 2, 0)
    assert counted([(0, 30), (1, 31)], is_sole=True) == (0, 0)
    assert counted(came) == (0, 0)
