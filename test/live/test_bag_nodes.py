"""Recorder and player on a live graph: bags after a sudden end, and playback."""

import resource
import signal
from itertools import count, pairwise

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from support.bag_maker import Maker
from support.doctor import Doctor
from support.timeouts import PATIENCE_S

from thinmap_ros.logs.bag_writer import BagWriter
from thinmap_ros.logs.readers.bag import Bag
from thinmap_ros.logs.storage import recorded
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
STRING = 'std_msgs/msg/String'
SCAN = 'sensor_msgs/msg/LaserScan'
GRAPH = 'thinmap_msgs/msg/TopologicalMap'
BEST_EFFORT = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)


def talks(graph, topic, size=100):
    """Publishes increasing numbers on a topic; each call returns the count."""
    publisher = graph.node.create_publisher(String, topic, qos.STREAM)
    graph.until(publisher.get_subscription_count, f'a subscriber of {topic}')
    said = count()

    def talk():
        number = next(said)
        publisher.publish(String(data=f'{number} '.ljust(size, 'x')))
        return number + 1

    return talk


def numbers(path):
    bag = Bag(path)
    return [int(bag.decode(m).data.split()[0]) for m in bag.messages({'/said'})], bag


def on_disk(graph, talk, doctor, least):
    """Publish until the recorder has written a number of messages and flushed them to disk.

    It flushes twice per diagnostics message. Returns the number of expected messages.
    """
    graph.until(lambda: talk() and doctor.number('recorder', 'messages written') > least, 'some')
    written = doctor.number('recorder', 'messages written')
    told = doctor.times('recorder') + 3
    graph.until(lambda: talk() and doctor.times('recorder') >= told, 'time to flush')
    return written


def test_a_killed_recorder_loses_no_more_than_what_came_since_the_last_flush(graph, tmp_path):
    doctor = Doctor(graph)
    recorder = graph.start('recorder', bag=str(tmp_path / 'bag'))
    written = on_disk(graph, talks(graph, 'said'), doctor, 50)
    recorder.send_signal(signal.SIGKILL)
    recorder.wait()
    del graph.processes['recorder']
    found, bag = numbers(tmp_path / 'bag')
    assert bag.is_truncated
    assert found == list(range(len(found)))
    assert len(found) > 10
    assert sum(1 for _ in bag.messages(set(bag.topics))) >= written


def test_a_full_disk_ends_the_recording_in_words_and_what_is_written_stays_readable(
    graph, tmp_path
):
    doctor = Doctor(graph)
    recorder = graph.start('recorder', bag=str(tmp_path / 'bag'))
    talk = talks(graph, 'said', size=1000)
    on_disk(graph, talk, doctor, 20)
    size = (tmp_path / 'bag' / 'bag.mcap').stat().st_size
    before = len(numbers(tmp_path / 'bag')[0])
    # A limit of the file size is a reliable substitute for a full disk.
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (size + 3000, size + 3000))
    del graph.processes['recorder']
    graph.until(lambda: talk() and recorder.poll() is not None, 'the recorder gives up')
    assert recorder.returncode == 2
    (line,) = [line for line in graph.log('recorder').splitlines() if line.startswith('error: ')]
    assert str(tmp_path / 'bag') in line and 'recording ends here' in line
    assert 'Traceback' not in graph.log('recorder')
    found, bag = numbers(tmp_path / 'bag')
    assert bag.is_truncated
    assert found == list(range(len(found))) and len(found) >= before > 0


@pytest.fixture
def bag(tmp_path):
    """Ten scans, ten best-effort words and two latched signs, one per second."""
    writer = BagWriter(tmp_path / 'bag', live=True)
    make = writer.typestore.types
    writer.add_topic('/robot/scan', SCAN, [recorded(5, True, False)])
    writer.add_topic('/said', STRING, [recorded(0, False, False)])
    writer.add_topic('/sign', STRING, [recorded(1, True, True)])
    for i in range(10):
        ns = 10**12 + i * 10**9
        if i in (1, 6):
            writer.write('/sign', STRING, ns, make[STRING](data=f'{i}'))
        writer.write('/said', STRING, ns + 1, make[STRING](data=f'{i}'))
        writer.write('/robot/scan', SCAN, ns + 2, scan(make, ns))
    writer.close()
    return tmp_path / 'bag'


def scan(make, ns):
    stamp = make['builtin_interfaces/msg/Time'](sec=ns // 10**9, nanosec=ns % 10**9)
    return make[SCAN](
        header=make['std_msgs/msg/Header'](stamp=stamp, frame_id='laser'),
        angle_min=-0.5,
        angle_max=0.5,
        angle_increment=0.25,
        time_increment=0.0,
        scan_time=0.0,
        range_min=0.05,
        range_max=8.0,
        ranges=np.full(5, 2.0, dtype=np.float32),
        intensities=np.zeros(0, dtype=np.float32),
    )


def seconds(heard):
    return [messages.stamp_ns(message.header.stamp) // 10**9 - 1000 for message in heard]


def offered(graph, topic):
    (info,) = graph.node.get_publishers_info_by_topic(topic)
    return info.qos_profile


def test_a_bag_is_offered_as_it_was_recorded_and_under_other_names(graph, bag):
    scans = graph.heard('/r1/scan', LaserScan)
    words = graph.heard('/here/said', String, BEST_EFFORT)
    player = graph.start(
        'bag_player',
        bag=str(bag),
        rate=20.0,
        prefix='here',
        start_paused=True,
        remap=('/here/robot/scan:=/r1/scan',),
    )
    signs = graph.heard('/here/sign', String, qos.LATCHED)
    doctor = Doctor(graph)
    keys = [f'{topic}: subscribers' for topic in ('here/sign', 'here/said', 'r1/scan')]
    # It knows the test: of a latched topic, who comes late hears the last message alone.
    graph.until(lambda: all(doctor.number('bag_player', key) for key in keys), 'it')
    assert offered(graph, '/here/said').reliability == ReliabilityPolicy.BEST_EFFORT
    assert offered(graph, '/here/sign').durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert offered(graph, '/r1/scan').reliability == ReliabilityPolicy.RELIABLE
    assert offered(graph, '/r1/scan').durability == DurabilityPolicy.VOLATILE
    graph.call(SetBool, '/bag_player/pause', SetBool.Request(data=False))
    graph.until(lambda: len(scans) == 10, 'all scans')
    late = graph.heard('/here/sign', String, qos.LATCHED)
    graph.until(
        lambda: late or player.poll() is not None,
        'who comes late hears the sign, or comes too late',
    )
    graph.until(lambda: player.poll() == 0, 'the end')
    assert [message.data for message in signs] == ['1', '6'] and words
    assert '22 messages sent: /robot/scan 10, /said 10, /sign 2' in graph.log('bag_player')


def test_a_bag_is_paused_stepped_and_begun_in_its_middle(graph, bag):
    scans = graph.heard('/robot/scan', LaserScan)
    clock = graph.heard('/clock', Clock)
    signs = graph.heard('/sign', String, qos.LATCHED)
    doctor = Doctor(graph)
    graph.start('bag_player', bag=str(bag), start_offset_s=4.0, start_paused=True, rate=0.5)

    def step():
        return graph.call(Trigger, '/bag_player/step', Trigger.Request())

    graph.until(lambda: signs, 'what was latched before the offset')
    assert signs[0].data == '1' and not scans
    # It has discovered the subscribers of the scans, too.
    graph.until(lambda: doctor.status('bag_player').message == 'paused', 'the player')
    for taken in (1, 2, 3):
        response = step()
        assert response.success and response.message.endswith('s'), response.message
        graph.until(lambda n=taken: len(scans) == n, 'one scan a step')
    assert seconds(scans) == [4, 5, 6]
    graph.until(lambda: [sign.data for sign in signs] == ['1', '6'], 'the second sign')
    clock.clear()
    graph.until(lambda: len(clock) > 20, 'the clock, which stands still')
    assert len({messages.stamp_ns(tick.clock) for tick in clock[-5:]}) == 1
    assert graph.call(SetBool, '/bag_player/pause', SetBool.Request(data=False)).success
    response = step()
    assert not response.success and 'not paused' in response.message
    graph.until(lambda: len(scans) > 3, 'it continues')
    ticks = [messages.stamp_ns(tick.clock) for tick in clock]
    assert ticks == sorted(ticks) and len(set(ticks)) > 5
    assert graph.stop('bag_player') == 0


def test_a_loop_begins_again_with_the_clock(graph, bag):
    clock = graph.heard('/clock', Clock)
    answers = graph.node.create_publisher(PoseWithCovarianceStamped, 'pose', qos.STREAM)
    # Each scan is acknowledged: otherwise the player could overrun a slow test.
    graph.start(
        'bag_player',
        bag=str(bag),
        loop=True,
        rate=50.0,
        wait_for_subscribers=2,
        lockstep='pose',
        lockstep_timeout_s=PATIENCE_S,
    )
    graph.until(answers.get_subscription_count, 'a player that hears answers')

    def answer(message):
        answers.publish(PoseWithCovarianceStamped(header=message.header))

    graph.node.create_subscription(LaserScan, '/robot/scan', answer, qos.STREAM)
    scans = graph.heard('/robot/scan', LaserScan)

    def set_back():
        ticks = [messages.stamp_ns(tick.clock) for tick in clock]
        return [b for a, b in pairwise(ticks) if b < a]

    # Scans and clock do not arrive at the same time.
    graph.until(
        lambda: len(scans) > 25 and len(set_back()) == (len(scans) - 1) // 10,
        'two rounds and a half',
    )
    assert seconds(scans)[:20] == 2 * list(range(10))
    assert all(tick < 10**12 + 10**9 for tick in set_back())
    assert graph.stop('bag_player') == 0


def test_lockstep_plays_the_scans_of_two_lasers_before_what_both_wait_for(graph, tmp_path):
    """A localizer answers both once the odometry after them has come."""
    writer = BagWriter(tmp_path / 'bag', live=True)
    make = writer.typestore.types
    for i in range(10):
        ns = 10**12 + i * 10**9
        writer.write('/front/scan', SCAN, ns + 1, scan(make, ns + 1))
        writer.write('/rear/scan', SCAN, ns + 2, scan(make, ns + 2))
        writer.write('/said', STRING, ns + 3, make[STRING](data=f'{i}'))
    writer.close()
    waiting = []
    answers = graph.node.create_publisher(PoseWithCovarianceStamped, 'pose', qos.STREAM)

    def answer(_):
        while waiting:
            answers.publish(PoseWithCovarianceStamped(header=waiting.pop(0).header))

    for topic in ('/front/scan', '/rear/scan'):
        graph.node.create_subscription(LaserScan, topic, waiting.append, qos.STREAM)
    graph.node.create_subscription(String, '/said', answer, qos.STREAM)
    player = graph.start(
        'bag_player',
        bag=str(tmp_path / 'bag'),
        rate=50.0,
        lockstep='pose',
        lockstep_timeout_s=2.0 * PATIENCE_S,
    )
    graph.until(lambda: player.poll() == 0, 'the end')
    assert '30 messages sent: /front/scan 10, /rear/scan 10, /said 10' in graph.log('bag_player')
    assert 'continuing without it' not in graph.log('bag_player')


def test_a_bag_that_ends_before_the_offset_is_refused(graph, bag):
    player = graph.start('bag_player', bag=str(bag), start_offset_s=60.0)
    assert graph.ended(player) == 2
    assert 'start_offset_s = 60.0' in graph.log('bag_player').strip().splitlines()[-1]


@pytest.mark.parametrize(
    ('begin', 'said'),
    [(b'#ROSBAG V2.0\n', 'rosbag reindex'), (b'SQLite format 3\0', '')],
)
def test_the_player_names_a_file_that_is_cut_off(graph, tmp_path, begin, said):
    (tmp_path / 'old.bag').write_bytes(begin + bytes(100))
    player = graph.start('bag_player', bag=str(tmp_path / 'old.bag'))
    del graph.processes['bag_player']
    assert graph.ended(player) == 2
    (line,) = [line for line in graph.log('bag_player').splitlines() if line.startswith('error: ')]
    assert 'old.bag' in line and said in line


def test_the_player_leaves_out_topics_whose_names_are_damaged(graph, tmp_path):
    writer = BagWriter(tmp_path / 'bag', live=True)
    string = writer.typestore.types[STRING]
    for topic in ('/said', '/sa id'):
        writer.write(topic, STRING, 10**9, string(data='0'))
    writer.close()
    heard = graph.heard('said', String)
    graph.start('bag_player', bag=str(tmp_path / 'bag'))
    graph.until(lambda: heard, 'what was said')
    assert '/sa id is not played: Invalid topic name' in graph.log('bag_player')
    assert 'Traceback' not in graph.log('bag_player')


def test_the_player_leaves_out_topics_whose_types_are_of_another_version(graph, tmp_path):
    definitions = {GRAPH: 'std_msgs/Header header\nuint32[] nodes\nuint32[] edges\n'}
    writer = BagWriter(tmp_path / 'bag', live=True, definitions=definitions)
    make = Maker(writer)
    none = np.zeros(0, dtype=np.uint32)
    old = make(GRAPH, header=make.header('map', 10**9), nodes=none, edges=none)
    writer.write('/topology', GRAPH, 10**9, old)
    writer.write('/said', STRING, 10**9, make(STRING, data='0'))
    writer.close()
    reason = f'{GRAPH} of another version, with header, nodes, edges: expected header, map_id, '
    heard = graph.heard('said', String)
    graph.start('bag_player', bag=str(tmp_path / 'bag'))
    graph.until(lambda: heard, 'what was said')
    assert f'/topology is not played: {reason}' in graph.log('bag_player')
    assert 'Traceback' not in graph.log('bag_player')
    chosen = graph.start(
        'bag_player', label='chosen', bag=str(tmp_path / 'bag'), topics='/topology'
    )
    assert graph.ended(chosen) == 2
    assert graph.log('chosen').strip().splitlines()[-1].startswith(f'error: /topology: {reason}')
