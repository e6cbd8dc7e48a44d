"""Somebody tells the localizer on which storey the robot is: a lift, or a person."""

import pytest
from std_msgs.msg import String
from std_srvs.srv import Trigger

from thinmap_msgs.msg import SlamStatus
from thinmap_msgs.srv import SaveMap, SetMapTag
from thinmap_ros.files.sessions import load_tag

pytestmark = pytest.mark.live


def is_apart(status):
    return bool(status) and status[-1].state == SlamStatus.MAPPING_APART


def test_a_lift_says_where_the_robot_is_and_the_map_keeps_its_tag(graph, tmp_path):
    status = graph.heard('slam_status', SlamStatus)
    lift = graph.node.create_publisher(String, 'map_tag', 10)
    graph.start('sim', world='room_10x10', start='2,2,0')
    graph.start('localizer', use_sim_time=True, map_tag='first', save_directory=str(tmp_path))

    def told(tag):
        return graph.call(SetMapTag, 'set_map_tag', SetMapTag.Request(tag=tag))

    graph.until(lambda: len(status) > 5 and not is_apart(status), 'a first map')
    refused = told('')
    assert (refused.success, refused.message) == (
        False,
        "map_tag = '': expected the name of a storey",
    )
    assert told('first').message == "the map is of 'first'"
    graph.until(lift.get_subscription_count, 'a subscriber of map_tag')
    lift.publish(String(data='second'))
    graph.until(lambda: is_apart(status), 'a piece of map apart')
    assert told('second').message == "a piece of map apart is of 'second'"
    saved = graph.call(SaveMap, 'save_localizer', SaveMap.Request(path='tagged'))
    assert saved.success, saved.message
    assert load_tag(str(tmp_path / 'tagged')) == 'first'
    assert graph.call(Trigger, 'localizer/reset', Trigger.Request()).success
    graph.until(lambda: not is_apart(status), 'a new map')
    assert told('second').message == "the map is of 'second'", 'where the robot is'
