"""Which map a message belongs to."""

from thinmap_ros.ros.maps import UNKNOWN, FollowedMap, Origin, new_map_id


def test_a_node_follows_the_first_map_that_it_hears_of():
    followed = FollowedMap()
    assert followed.origin(UNKNOWN) is Origin.SAME
    assert followed.origin(7) is Origin.SAME
    assert followed.id == 7
    assert followed.origin(UNKNOWN) is Origin.SAME, 'of a SLAM that gives its maps no ids'
    assert followed.origin(8) is Origin.OTHER
    assert followed.id == 7


def test_after_a_load_messages_of_the_map_before_are_stale_and_the_next_id_is_followed():
    followed = FollowedMap(7)
    followed.leave()
    assert followed.origin(7) is Origin.STALE
    assert followed.origin(9) is Origin.SAME
    assert followed.id == 9
    followed.leave()
    followed.leave()
    assert followed.origin(9) is Origin.STALE


def test_ids_differ():
    ids = {new_map_id() for _ in range(3)}
    assert UNKNOWN not in ids
