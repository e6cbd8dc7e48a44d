"""The page on a live graph, asked by sockets: it shows the robot, and what it asks for happens."""

import base64
import io
import os
import random
import re
import signal
import time

import numpy as np
import pytest
from fuzz.strange_requests import mutated
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import Path
from PIL import Image
from rclpy.action import ActionClient
from std_msgs.msg import Bool
from support.driven_pieces import driven_piece
from support.hidden_library import hide
from support.team_talk import ME, TeamTalk
from support.web_client import WebClient

from thinmap_ros.core.grid.edits import KeepOut, MapEdits
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.topology.topology import TopologyBuilder
from thinmap_ros.files.sessions import TOPOLOGY, load_edits, load_grid, load_topology, save_grid
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
START = '2.0,2.0,0.0'
AT_START = {'initial_x_m': 2.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.0}
STANDS = (0.0, 0.0)
# Time waits for the nodes, which a busy machine delays: three subscribe to scans.
PACED = {'lockstep': 'local_topology', 'wait_for_subscribers': 3}
# Of a navigator while simulated time passes four times as fast: ten in each of its seconds.
COMMANDS_A_SECOND = 40


class Site:
    """The node, and pages of it that are waited for while the graph spins."""

    def __init__(self, graph, **values):
        self.graph = graph
        graph.start('web', port=0, **values)
        graph.until(lambda: 'page at' in graph.log('web'), 'the address')
        self.port = int(re.search(r'page at http://[^ ]+:(\d+)/', graph.log('web'))[1])

    def open(self, **settings):
        page = WebClient(self.port, **settings)
        page.until(lambda: 'held' in page.items or page.closed.is_set(), 'the first items')
        return page

    def until(self, condition, what):
        self.graph.until(condition, what)


def held_joystick(page, is_done, **values):
    """A condition that drives as a page does, ten times a second; more would close the page."""
    asked = [0.0]

    def drives():
        if time.monotonic() - asked[0] >= 0.1:
            asked[0] = time.monotonic()
            page.ask('drive', **values)
        return is_done()

    return drives


def news(page):
    return page.news[-1] if page.news else ''


def velocities(heard):
    return [(twist.linear.x, twist.angular.z) for twist in heard]


@pytest.mark.cpu_budget(15.0, 'a robot that explores and drives')
def test_a_robot_is_seen_sent_and_stopped(graph):
    site = Site(graph, use_sim_time=True)
    page = site.open()
    plans = graph.heard('plan', Path, qos.LATCHED)
    truth = graph.heard('ground_truth', PoseStamped)
    commands = graph.heard('cmd_vel', Twist)
    graph.start('navigator', use_sim_time=True)
    graph.start('localizer', use_sim_time=True, **AT_START)
    graph.start('grid_mapper', use_sim_time=True)
    graph.start('topology_builder', use_sim_time=True)
    graph.start('sim', start=START, real_time_factor=4.0, **PACED)
    names = ('map', 'robot', 'laser', 'slam', 'path', 'graph', 'diagnostics', 'key')
    site.until(lambda: page.items.keys() >= set(names), 'all that is shown')
    assert any(name.startswith('tile/') for name in page.items)
    assert page.items['slam']['state'] == 'TRACKING'
    assert page.items['robot']['pose'][:2] == pytest.approx([2.0, 2.0], abs=0.1)
    assert len(page.items['laser']['points_cm']) > 100
    other = site.open()
    page.ask('goal', x=2.6, y=2.2, theta=1.0)
    site.until(lambda: news(page).startswith('goal done'), 'the goal')
    there = messages.pose_from_msg(truth[-1].pose)
    assert there == pytest.approx([2.6, 2.2, 1.0], abs=0.25) and plans
    other.until(lambda: news(other) == news(page), 'the same on the other page')

    page.ask('goal', x=2.0, y=4.5, theta=0.0)
    site.until(lambda: commands and commands[-1].linear.x > 0.1, 'the robot drives')
    accepted = page.news.count('goal accepted')
    page.ask('goal', x=2.2, y=4.4, theta=0.0)
    site.until(lambda: page.news.count('goal accepted') > accepted, 'a newer goal')
    asked = len(commands)
    other.ask('stop')
    site.until(lambda: velocities(commands[-1:]) == [STANDS], 'a stop')
    # Within a second, of which a busy machine makes more; its usual time is measured elsewhere.
    assert len(commands) - asked < COMMANDS_A_SECOND
    for each in (page, other):
        each.until(lambda each=each: each.items['held'] and each.items['goal'] is None, 'held')
    page.ask('goal', x=2.0, y=4.5, theta=0.0)
    page.until(lambda: page.refusals, 'a refusal')
    assert 'stopped' in page.refusals[0]
    # Nobody else drives it, either.
    client = ActionClient(graph.node, NavigateToPose, 'navigate_to_pose')
    goal = NavigateToPose.Goal(pose=messages.pose_stamped_msg([2.0, 4.5, 0.0], 'map', 0))
    result = graph.result(graph.send_goal(client, goal), 'navigate_to_pose')
    assert 'stopped' in result.result.error_msg
    commands.clear()
    site.until(lambda: len(commands) > 5, 'stops as long as it is held')
    assert set(velocities(commands)) == {STANDS}
    shown = page.items['held']
    other.ask('stop')
    other.until(lambda: other.items['held'] == shown + 1, 'stopped again')
    page.refusals.clear()
    page.ask('release', stop=shown)  # it has not seen the second stop
    page.until(lambda: page.refusals, 'a refusal')
    assert 'stopped again' in page.refusals[0] and page.items['held']
    page.ask('release', stop=shown + 1)
    other.until(lambda: not other.items['held'], 'released')
    page.ask('home')
    site.until(lambda: news(page).startswith('goal done'), 'home')
    assert messages.pose_from_msg(truth[-1].pose)[:2] == pytest.approx([2.0, 2.0], abs=0.25)
    page.ask('keep_out', corners=[[3.0, 3.0], [3.5, 3.0], [3.5, 3.5]], is_wall=False)
    other.until(lambda: other.items['keep_out'], 'an area')
    assert other.items['keep_out'][0]['corners'] == [3.0, 3.0, 3.5, 3.0, 3.5, 3.5]
    page.ask('keep_out', corners=[[3.0, 3.0], [3.5, 3.0]], is_wall=False)
    site.until(lambda: 'expected 3 to 200' in news(page), 'no area')
    page.ask('remove_keep_out', area=other.items['keep_out'][0]['id'])
    other.until(lambda: not other.items['keep_out'], 'no area any more')
    page.ask('erase', corners=[[3.0, 3.0], [3.5, 3.0], [3.5, 3.5]])
    site.until(lambda: news(page).startswith('erase: the cells are unknown'), 'erased')
    page.ask('save', name='room')
    site.until(lambda: news(page).startswith('save:'), 'saved')
    assert (graph.folder / 'room.pgm').exists() and 'room' in news(page)
    assert not any('replaced' in told for told in page.news)  # goals that the page has replaced
    for name in list(graph.processes):
        assert graph.stop(name, signal.SIGTERM) == 0
    page.until(page.closed.is_set, 'the end')


def test_a_joystick_drives_while_it_is_held_and_no_longer(graph):
    site = Site(graph, max_drive_speed_m_s=0.2, max_drive_turn_rad_s=0.5)
    commands = graph.heard('cmd_vel', Twist)
    page = site.open()
    other = site.open()

    def until_driven(by, velocity, what, **values):
        site.until(
            held_joystick(by, lambda: velocities(commands[-1:]) == [velocity], **values), what
        )

    until_driven(page, (0.1, -0.5), 'commands', ahead=0.5, left=-1.0)
    assert set(velocities(commands)) == {(0.1, -0.5)}
    # One of two joysticks is refused, whichever a busy machine has held up.
    both = held_joystick(other, lambda: page.refusals or other.refusals, ahead=1.0, left=0.0)
    site.until(held_joystick(page, both, ahead=0.5, left=-1.0), 'a refusal')
    assert 'another page drives' in (page.refusals + other.refusals)[0]
    site.until(lambda: velocities(commands[-1:]) == [STANDS], 'the stop of both')
    until_driven(page, (0.1, -0.5), 'commands of the first', ahead=0.5, left=-1.0)
    page.refusals.clear()
    # Held no longer, without a word.
    site.until(lambda: velocities(commands[-1:]) == [STANDS], 'the stop of a silent page')
    # The node is held up: what the page has asked for meanwhile is old when it is read.
    process = graph.processes['web'].pid
    page.until(lambda: 'beat' in page.items, 'a beat')
    os.kill(process, signal.SIGSTOP)
    heard = page.items['beat']
    for _ in range(20):
        page.ask_at(heard, 'drive', ahead=0.5, left=-1.0)
    page.ask_at(heard, 'initial_pose', x=1.0, y=1.0, theta=0.0)
    time.sleep(2.1)
    graph.drain()
    commands.clear()
    os.kill(process, signal.SIGCONT)
    # The last is refused when all before it were; what was on its way before is late as well.
    page.until(lambda: any('initial_pose' in text for text in page.refusals), 'the last refusal')
    assert len(page.refusals) >= 21
    assert all('late' in text for text in page.refusals)
    assert set(velocities(commands)) <= {STANDS}
    page.ask('resume')
    site.until(lambda: 'no exploration is paused' in news(page), 'nothing to continue')
    # The connection is lost.
    until_driven(page, (0.1, -0.5), 'commands again', ahead=0.5, left=-1.0)
    page.drop()
    site.until(lambda: velocities(commands[-1:]) == [STANDS], 'the stop of a lost page')

    until_driven(other, (0.2, 0.0), 'the other page drives', ahead=1.0, left=0.0)
    # Somebody else stops the robot.
    graph.node.create_publisher(Bool, 'stop', qos.LATCHED).publish(Bool(data=True))
    site.until(lambda: other.items['held'], 'held')
    site.until(lambda: velocities(commands[-1:]) == [STANDS], 'the stop of somebody else')
    commands.clear()
    other.ask('drive', ahead=1.0, left=0.0)
    site.until(lambda: len(commands) > 3, 'stops')
    assert set(velocities(commands)) == {STANDS}
    assert graph.stop('web') == 0


def test_a_dead_node_leaves_no_command(graph):
    site = Site(graph)
    commands = graph.heard('cmd_vel', Twist)
    page = site.open()

    site.until(held_joystick(page, lambda: commands, ahead=1.0, left=0.0), 'commands')
    assert graph.stop('web') == 0
    graph.drain()
    assert velocities(commands[-1:]) == [STANDS]


def test_ten_thousand_strange_messages_do_nothing(graph):
    site = Site(graph)
    poses = graph.heard('initialpose', PoseWithCovarianceStamped)
    commands = graph.heard('cmd_vel', Twist)
    stops = graph.heard('stop', Bool)
    rng = random.Random(7)
    sent = 0
    while sent < 10_000:
        page = site.open()
        for _ in range(100):
            page.send_text(mutated(rng))
            sent += 1
        page.close()
        graph.executor.spin_once(timeout_sec=0.0)
    page = site.open()
    page.ask('pause')
    site.until(lambda: news(page) == 'exploration paused', 'an answer')
    graph.drain()
    assert not poses and not commands and not stops
    assert 'Traceback' not in graph.log('web') and graph.stop('web') == 0


def test_tokens_are_made_printed_once_and_asked_for(graph):
    site = Site(graph, host='0.0.0.0', web_token_file='tokens')
    site.until(lambda: '\n█' in graph.log('web').partition('to watch')[2], 'both links')
    log = graph.log('web')
    links = re.findall(r'to (?:steer|watch): (http://([^#]+):\d+/#(\S+))', log)
    (_, host, steer), (_, _, watch) = links
    assert host != '0.0.0.0'
    # A code for each, in the terminal: blocks of a quiet zone around.
    assert log.count('█' * 30) >= 4
    assert (graph.folder / 'tokens').stat().st_mode & 0o777 == 0o600
    assert site.open(token='x' * 22).items == {}
    assert site.open(token=watch).items['hello'] == {'role': 'watch'}
    assert site.open(token=steer).items['hello'] == {'role': 'steer'}
    assert graph.stop('web') == 0
    Site(graph, host='0.0.0.0', web_token_file='tokens')
    assert steer not in graph.log('web') and watch not in graph.log('web')


def test_two_sessions_are_shown_together_before_they_are_saved(graph):
    maps = graph.folder / 'maps'
    for name, drive in (('east', (1, 1)), ('west', (1, 2)), ('foreign', (11, 1))):
        save_piece(maps / name, driven_piece(*drive).piece)
    wall = KeepOut().with_area(np.array([[0.0, 0.0], [1.0, 0.0]]), is_wall=True)
    save_grid(str(maps / 'west'), load_grid(str(maps / 'west')), edits=MapEdits(wall))
    site = Site(graph, save_directory='maps')
    page = site.open()
    page.ask('sessions')
    page.until(lambda: page.items.get('sessions') == ['east', 'foreign', 'west'], 'the names')
    page.ask('merge', first='east', second='away')
    page.until(lambda: 'away: expected a session' in news(page), 'the refusal')
    page.ask('merge', first='east', second='foreign')
    page.until(lambda: page.items.get('merge', {}).get('state') == 'failed', 'another building')
    assert 'foreign: not the same place (log odds' in page.items['merge']['words'][0]
    page.ask('merge', first='east', second='west')
    page.until(lambda: page.items['merge']['state'] == 'working', 'the work')
    page.ask('merge', first='east', second='foreign')
    page.until(lambda: 'expected the last one' in news(page), 'one at a time')
    page.until(lambda: page.items['merge']['state'] == 'shown', 'the preview')
    assert re.match(r'west: at .* log odds \d+', page.items['merge']['words'][0])
    shown = Image.open(io.BytesIO(base64.b64decode(page.items['merge']['picture'])))
    assert shown.width > 1000
    assert not (maps / 'both.pgm').exists()
    page.ask('merge_save', name='east')
    page.until(lambda: 'east: exists: expected a new name' in news(page), 'nothing is replaced')
    page.ask('merge_save', name='both')
    page.until(lambda: page.items['merge']['state'] == 'saved', 'the joint session')
    page.until(lambda: 'both' in page.items['sessions'], 'its name')
    free = {name: load_grid(str(maps / name)).known_area().free.sum() for name in ('east', 'both')}
    assert free['both'] > free['east'] and load_topology(str(maps / 'both')).map.nodes
    assert len(load_edits(str(maps / 'both')).keep_out.areas) == 1
    page.ask('merge', first='east', second='west')
    page.until(lambda: page.items['merge']['state'] == 'working', 'work that is dropped')
    page.ask('merge_drop')
    page.until(lambda: page.items['merge']['state'] == '', 'nothing')
    page.ask('merge', first='west', second='east')
    page.until(lambda: page.items['merge']['state'] == 'working', 'work that ends with the node')
    assert graph.stop('web') == 0


def save_piece(path, piece):
    path.parent.mkdir(exist_ok=True)
    save_grid(str(path), OccupancyGrid.from_patch(piece.patch))
    TOPOLOGY.save(str(path), TopologyBuilder.continued(piece.patch, piece.graph, 5000))


def test_other_robots_of_a_team_are_shown_where_they_are(graph):
    site = Site(graph, team=True, team_name=ME)
    page = site.open()
    talk = TeamTalk(graph)

    def shown():
        talk.join()
        talk.stands_at(3.0, -1.5)
        graph.executor.spin_once(timeout_sec=0.01)
        return page.items.get('robots')

    site.until(shown, 'the other robot')
    ((name, *pose),) = page.items['robots']
    assert name == 'robot2' and pose == pytest.approx([3.0, -1.5, 0.0], abs=0.01)
    talk.join(is_joined=False)
    site.until(lambda: page.items['robots'] == [], 'no robot without a place')


@pytest.mark.parametrize(
    ('values', 'said'),
    [
        ({'host': '0.0.0.0'}, 'host 0.0.0.0: others than this machine could steer'),
        ({'web_token_file': '/nowhere/tokens'}, 'web_token_file /nowhere/tokens: No such file'),
    ],
)
def test_what_is_not_safe_does_not_start(graph, values, said):
    process = graph.start('web', port=0, **values)
    assert graph.ended(process) == 2
    assert said in graph.log('web').strip().splitlines()[-1]


def test_without_tornado_the_start_ends_with_one_clear_line(graph, tmp_path_factory, monkeypatch):
    hide('tornado', tmp_path_factory.mktemp('hidden'), monkeypatch)
    process = graph.start('web')
    assert graph.ended(process) == 2
    last = graph.log('web').strip().splitlines()[-1]
    assert last == 'error: tornado is not installed: pip install tornado'
