"""Each reason to stop: the first cause, with its value and what is needed."""

from dataclasses import replace

import numpy as np
import pytest
from rclpy.clock import ROSClock
from rclpy.time import Time
from support.slam_room import ROOM, drive, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.nodes.parts.driving import RobotState
from thinmap_ros.ros.time_jumps import ElapsedTime

S = 1_000_000_000
STEP_NS = S // 20
SCAN_STEPS = 4


class Robot:
    """A robot that drives ahead at 0.5 m/s, as its navigator hears of it.

    late_ns, stamp_ns: by which the data of a source are received late, or their stamps are wrong;
    silent: sources that publish nothing.
    """

    def __init__(self, has_odometry=True, scan_steps=SCAN_STEPS):
        self.clock = ROSClock()
        self.clock._set_ros_time_is_active(True)
        self.state = RobotState(ElapsedTime(self.clock), has_odometry)
        self.late_ns = {'odometry': 0, 'laser': 0}
        self.stamp_ns = {'odometry': 0, 'laser': 0}
        self.silent = set()
        self.is_blind = False
        self._scan_steps = scan_steps
        self._k = 200
        self._jump_ns = 0
        self._sent_ns = {'odometry': 0, 'laser': 0}

    def stamp(self, source='odometry'):
        ns = self._k * STEP_NS + self._jump_ns
        return ns - self.late_ns[source] + self.stamp_ns[source]

    def set_clock(self):
        now_ns = self._k * STEP_NS + self._jump_ns
        self.clock.set_ros_time_override(Time(nanoseconds=now_ns, clock_type=self.clock.clock_type))

    def jump(self, seconds):
        self._jump_ns += seconds * S

    def run(self, seconds):
        """Reasons to stop at each step, each once, in their order."""
        found = []
        for _ in range(seconds * S // STEP_NS):
            self._k += 1
            self.set_clock()
            self._publish()
            found.append(self.state.stop_reason())
        return list(dict.fromkeys(found))

    def _publish(self):
        x = 0.025 * self._k
        if self._sends('odometry'):
            self.state.add_odometry(self.stamp('odometry'), np.array([x, 0.0, 0.0]))
        if self._k % self._scan_steps:
            return
        if self._sends('laser'):
            ranges = 3.0 + 0.001 * np.random.default_rng(self._k).standard_normal(61)
            scan = Scan.create(self.stamp('laser'), ranges, -1.5, 0.05, 0.05, 8.0)
            self.state.add_scan(scan.blinded('no hits') if self.is_blind else scan)
        if 'localizer' not in self.silent:
            self.state.add_pose(self.stamp('laser') - 2 * STEP_NS, np.array([x, 0.0, 0.0]))

    def _sends(self, source):
        """Whether a source publishes; one whose delay grows is silent meanwhile."""
        is_old = self.stamp(source) <= self._sent_ns[source]
        self._sent_ns[source] = max(self.stamp(source), self._sent_ns[source])
        return not (is_old or source in self.silent)


def test_a_robot_that_knows_everything_has_no_reason_to_stop():
    robot = Robot()
    assert robot.run(60) == ['']
    assert len(robot.state.scans) == 1 and not robot.state.awaited
    assert robot.state.pose() is not None


def test_without_any_input_there_is_no_pose_and_no_fault():
    robot = Robot()
    robot.silent = {'odometry', 'laser', 'localizer'}
    assert robot.run(10) == ['']
    assert robot.state.pose() is None
    assert robot.state.awaited == ['laser', 'pose or odometry']


@pytest.mark.parametrize(
    ('silent', 'after'),
    [
        ({'laser'}, 'laser silent for 0.5 s'),
        ({'odometry'}, 'odometry silent for 0.5 s'),
        ({'laser', 'odometry', 'localizer'}, 'laser silent for 0.5 s'),
        ({'localizer'}, 'localizer silent for 3.1 s'),
    ],
)
def test_a_silent_source_is_named_and_its_return_ends_the_stop(silent, after):
    robot = Robot()
    robot.run(4)
    robot.silent = silent
    reasons = robot.run(5)
    assert reasons[0] == ''
    assert after in reasons[1:3]
    robot.silent = set()
    assert robot.run(5)[-1] == ''


def test_without_odometry_a_pose_is_needed_more_often():
    robot = Robot(has_odometry=False)
    robot.run(4)
    robot.silent = {'localizer'}
    assert 'localizer silent for 1.1 s' in robot.run(2)


@pytest.mark.parametrize('late_s', [1, 2, 5])
def test_what_is_late_stops_the_robot_with_the_source_and_the_delay(late_s):
    robot = Robot()
    robot.run(4)
    robot.late_ns = dict.fromkeys(robot.late_ns, late_s * S)
    assert robot.run(10)[-1] == f'laser {late_s:.1f} s late: expected at most 0.5 s'
    robot.late_ns['laser'] = 0
    assert robot.run(10)[-1] == f'odometry {late_s:.1f} s late: expected at most 0.5 s'
    robot.late_ns['odometry'] = 0
    assert robot.run(10)[-1] == ''


def test_a_clock_that_is_set_together_with_the_stamps_is_no_fault():
    robot = Robot()
    robot.run(4)
    for seconds in (2, 61, 100, 86400):
        robot.jump(seconds)
        assert robot.run(4)[-1] == ''


@pytest.mark.parametrize(('offset_s', 'side'), [(5, 'ahead of'), (-5, 'behind')])
def test_stamps_of_another_clock_are_named_before_the_pose_that_they_prevent(offset_s, side):
    robot = Robot()
    robot.stamp_ns['laser'] = offset_s * S
    reasons = robot.run(20)
    assert reasons[-1].startswith('scan stamps are ')
    assert reasons[-1].endswith(f" s {side} odometry's: expected at most 0.4 s")


def test_poses_of_another_clock_are_named():
    robot = Robot()
    robot.run(4)
    robot.silent = {'localizer'}
    for _ in range(5):
        robot.state.add_pose(robot.stamp() + 7 * S, np.zeros(3))
        reasons = robot.run(1)
    assert reasons[-1].startswith('pose stamps are 7.0 s ahead of')


def test_the_first_poses_are_named_at_once_if_they_are_of_another_clock():
    robot = Robot()
    robot.silent = {'localizer'}
    robot.run(4)
    assert robot.state.pose() is None
    robot.state.add_pose(robot.stamp() + 7 * S, np.zeros(3))
    assert robot.run(1)[-1].startswith('pose stamps are 7.0 s ahead of')
    robot.silent = set()
    assert robot.run(2)[-1] == ''
    robot.state.add_pose(robot.stamp() + 7 * S, np.zeros(3))
    assert robot.state.stop_reason() == '', 'the last good one holds'


def test_a_laser_at_one_hertz_is_told_its_rate():
    robot = Robot(scan_steps=S // STEP_NS)
    assert robot.run(30)[-1] == 'laser at 1.0 Hz: expected at least 2.5 Hz'


def test_a_blind_laser_comes_before_all_other_reasons():
    robot = Robot()
    robot.run(4)
    robot.is_blind = True
    robot.state.pose_fault = 'laser misaligned (turned on the robot)'
    robot.silent = {'odometry'}
    assert robot.run(4)[-1] == 'laser blind (no hits)'
    assert robot.state.scans[0].blind_reason == ''


class TwoLasers(Robot):
    """The same robot with a second laser, whose scans come right after those of the first.

    missing: topics without scans; blind: those whose lasers see nothing.
    """

    def __init__(self):
        super().__init__()
        self.state = RobotState(ElapsedTime(self.clock), True, ('front/scan', 'rear/scan'))
        self.missing = set()
        self.blind = set()
        self.ahead_ns = 0
        add = self.state.add_scan
        lasers = ('front', 'rear')
        self.state.add_scan = lambda scan: [self._add(add, scan, each) for each in lasers]

    def _add(self, add, scan, laser):
        topic = f'{laser}/scan'
        scan = replace(scan, frame=laser)
        if laser == 'rear':
            scan = replace(scan, stamp_ns=scan.stamp_ns + self.ahead_ns)
        if topic not in self.missing:
            add(scan.blinded('no hits') if topic in self.blind else scan, topic)


def test_one_of_two_lasers_that_is_silent_stops_the_robot_with_its_topic():
    robot = TwoLasers()
    assert robot.run(4) == ['']
    assert [scan.frame for scan in robot.state.scans] == ['front', 'rear']
    robot.missing = {'front/scan'}
    reasons = robot.run(4)
    assert reasons[0] == '' and 'front/scan silent for 0.5 s' in reasons[1:3]
    assert [scan.frame for scan in robot.state.scans] == ['rear']
    robot.missing = set()
    assert robot.run(4)[-1] == ''


def test_one_of_two_lasers_that_is_blind_stays_so_while_the_other_sees():
    robot = TwoLasers()
    robot.run(4)
    robot.blind = {'front/scan'}
    assert robot.run(4)[1:] == ['front/scan blind (no hits)']
    robot.blind = set()
    assert robot.run(4)[-1] == ''


def test_a_laser_that_never_came_is_awaited_by_its_topic():
    robot = TwoLasers()
    robot.missing = {'rear/scan'}
    assert robot.run(4) == ['']
    assert robot.state.awaited == ['rear/scan']


def test_the_stamps_of_one_of_two_lasers_are_named_by_its_topic():
    robot = TwoLasers()
    robot.ahead_ns = 5 * S
    assert robot.run(4)[-1].startswith('rear/scan stamps are 5.0 s ahead of')


def test_the_word_of_the_localizer_counts_while_sensors_are_sound():
    robot = Robot()
    robot.run(4)
    robot.state.pose_fault = 'laser misaligned (turned on the robot)'
    assert robot.run(1) == ['laser misaligned (turned on the robot)']
    robot.silent = {'laser'}
    assert robot.run(2)[-1].startswith('laser silent')


def test_a_paused_simulation_is_no_fault_of_the_sensors():
    robot = Robot()
    robot.run(4)
    robot.set_clock()
    assert robot.state.stop_reason() == ''
    assert robot.run(4) == ['']


def test_one_of_two_lasers_on_one_topic_that_is_silent_is_named():
    robot = Robot()
    robot.run(1)
    for frame in ('front', 'rear'):
        ranges = np.full(61, 3.0)
        scan = Scan.create(robot.stamp('laser'), ranges, -1.5, 0.05, 0.05, 8.0)
        robot.state.add_scan(replace(scan, frame=frame))
    robot.state.stop_reason()
    assert any(text.startswith("laser 'front' silent for") for text in robot.run(2))


@pytest.mark.parametrize('late_steps', [0, 4, 10])
def test_scans_received_after_later_odometry_do_not_make_a_laser_that_drops_out(late_steps):
    """A busy machine handles the scans of a robot that looks round a hall late."""
    rng = np.random.default_rng(4)
    robot = Robot()
    late = []
    for k, (truth, odom) in enumerate(drive(400, rng, se2.pose(2.0, 2.0, 0.0))):
        stamp_ns = 10 * S + k * STEP_NS
        robot.state.add_odometry(stamp_ns, odom)
        scan = replace(scan_in(ROOM, truth, rng, stamp_ns), range_max_m=2.5)
        late.append(scan)
        if len(late) > late_steps:
            robot.state.add_scan(late.pop(0))
            assert not robot.state.scans[0].drops_out
