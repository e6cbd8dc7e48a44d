"""The page in Chromium, driven by Playwright: `pip install playwright`, `apt install chromium`."""

import re
import shutil
import signal

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from support.driven_pieces import driven_piece

from thinmap_msgs.msg import KeepOut
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.files.sessions import save_grid
from thinmap_ros.ros import messages, qos

playwright = pytest.importorskip(
    'playwright.sync_api', reason='needs Playwright, which is not installed'
)
CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser')
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason='needs Chromium, which is not installed'),
]
AT_START = {'initial_x_m': 2.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.0}
CELL_M = 0.05
# Time waits for the nodes, which a busy machine delays: three subscribe to scans.
PACED = {'lockstep': 'local_topology', 'wait_for_subscribers': 3}


@pytest.fixture
def browser():
    with playwright.sync_playwright() as library:
        opened = library.chromium.launch(executable_path=CHROMIUM, args=['--no-sandbox'])
        yield opened
        opened.close()


# Two fingers on the map, one of which moves.
PINCH = """() => {
  const map = document.getElementById('map');
  map.setPointerCapture = () => {};
  const send = (name, id, x, y) => map.dispatchEvent(
    new PointerEvent(name, { pointerId: id, pointerType: 'touch', clientX: x, clientY: y }));
  send('pointerdown', 11, 300, 300);
  send('pointerdown', 12, 400, 300);
  send('pointermove', 12, 440, 300);
  send('pointerup', 12, 440, 300);
  send('pointerup', 11, 300, 300);
}"""


class Tab:
    """A page; errors: what its console says."""

    def __init__(self, graph, browser, address, width=1280, scheme='light'):
        self.graph = graph
        size = {'width': width, 'height': 800}
        self.page = browser.new_page(viewport=size, color_scheme=scheme)
        self.errors = []
        self.page.on('console', lambda said: self._hear(said.type, said.text))
        self.page.on('pageerror', lambda error: self.errors.append(str(error)))
        self.page.goto(address)

    def _hear(self, kind, text):
        if kind in ('error', 'warning'):
            self.errors.append(text)

    def item(self, name):
        return self.page.evaluate('name => thinmap.items.get(name)', name)

    def until(self, condition, what):
        self.graph.until(condition, what)

    def text(self, name):
        return self.page.locator(f'#{name}').inner_text()

    def event(self):
        """The newest event, without its time."""
        newest = self.page.locator('#log li').first
        return newest.inner_text()[len('00:00:00') :] if newest.count() else ''

    def is_live(self):
        return not self.page.locator('body.old').count()

    def is_disabled(self, name):
        return self.page.locator(f'#{name}').is_disabled()

    def place_on_screen(self, x, y):
        box = self.page.locator('#map').bounding_box()
        px, py = self.page.evaluate('([x, y]) => thinmap.view.toScreen(x, y)', [x, y])
        return box['x'] + px, box['y'] + py


def address_of(graph):
    graph.until(lambda: 'page at' in graph.log('web'), 'the address')
    return re.search(r'page at (\S+)', graph.log('web'))[1]


def names_of_regions(tab):
    return [region['name'] for region in tab.item('regions')]


def test_a_person_sees_the_robot_sends_it_and_stops_it(graph, browser):
    commands = graph.heard('cmd_vel', Twist)
    truth = graph.heard('ground_truth', PoseStamped)
    graph.start('web', use_sim_time=True, port=0)
    for name in ('grid_mapper', 'topology_builder', 'navigator'):
        graph.start(name, use_sim_time=True)
    graph.start('localizer', use_sim_time=True, **AT_START)
    graph.start('sim', start='2.0,2.0,0.0', real_time_factor=4.0, **PACED)
    tab = Tab(graph, browser, address_of(graph))
    tab.until(lambda: tab.item('robot') and tab.item('graph') and tab.item('map'), 'the map')
    tab.until(lambda: tab.text('slam-state') == 'TRACKING', 'the state')

    tab.page.get_by_role('button', name='Goal').click()
    x, y = tab.place_on_screen(2.6, 2.2)
    tab.page.mouse.move(x, y)
    tab.page.mouse.down()
    tab.page.mouse.move(x, y - 60, steps=4)
    tab.page.mouse.up()
    tab.until(lambda: tab.item('goal'), 'the goal')
    assert tab.item('goal') == pytest.approx([2.6, 2.2, 1.571], abs=CELL_M)
    tab.until(lambda: tab.event().startswith('goal done'), 'the robot arrives')
    # What the test receives comes later than what the page shows.
    there = pytest.approx([2.6, 2.2], abs=0.25)
    graph.until(lambda: messages.pose_from_msg(truth[-1].pose)[:2] == there, 'the robot is there')

    tab.until(lambda: tab.item('plan') == [], 'the plan of a goal that has ended is gone')
    narrow = Tab(graph, browser, address_of(graph), width=400, scheme='dark')
    narrow.until(lambda: narrow.item('robot'), 'the robot on the other page')
    assert narrow.page.evaluate('document.documentElement.scrollWidth') <= 400
    assert narrow.page.locator('#stop').is_visible()
    seen = narrow.page.locator('#view').bounding_box()
    stick = narrow.page.locator('#joystick').bounding_box()
    assert stick['y'] >= seen['y'] + seen['height'], 'the joystick covers the map'
    tab.page.keyboard.press('Space')
    for each in (tab, narrow):
        each.until(lambda each=each: each.text('stop') == 'STOPPED', 'stopped')
        goal = each.page.locator('#go')
        each.until(
            lambda goal=goal: 'released first' in goal.get_attribute('title'),
            'no goal while it is stopped',
        )
        assert each.is_disabled('go')
        assert each.text('status').startswith('stopped: ')
    narrow.page.get_by_role('button', name='Release').click()
    tab.until(lambda: tab.text('stop') == 'STOP', 'released')

    tab.until(lambda: tab.item('regions'), 'the rooms')
    room = tab.item('regions')[0]
    tab.page.mouse.click(*tab.place_on_screen(*room['center']))
    assert tab.page.evaluate('thinmap.view.chosen') == room['id']
    x, y = re.findall(r'-?[0-9.]+', tab.text('place'))
    assert [float(x), float(y)] == pytest.approx(room['center'], abs=CELL_M)
    assert re.fullmatch(r'[0-9.]+ m', tab.text('scale'))
    # In this field the space bar types, and does not stop the robot.
    tab.page.locator('#region-name').press_sequentially('my room')
    tab.page.get_by_role('button', name='Name it').click()
    for each in (tab, narrow):
        each.until(lambda each=each: 'my room' in names_of_regions(each), 'its name')
    assert tab.text('stop') == 'STOP'
    assert 'my room' in tab.text('regions')

    commands.clear()
    box = tab.page.locator('#joystick').bounding_box()
    tab.page.mouse.move(box['x'] + box['width'] / 2, box['y'] + 5)
    tab.page.mouse.down()
    tab.until(lambda: commands and commands[-1].linear.x > 0.2, 'it drives')
    assert not tab.errors and not narrow.errors
    tab.page.close()
    graph.until(lambda: commands[-1].linear.x == 0.0, 'it stops when the page is gone')


def test_what_is_drawn_by_mistake_is_forgotten(graph, browser):
    areas = graph.heard('keep_out', KeepOut, qos.LATCHED)
    poses = graph.heard('initialpose', PoseWithCovarianceStamped)
    graph.start('web', port=0)
    graph.start('grid_mapper')
    tab = Tab(graph, browser, address_of(graph))
    tab.until(tab.is_live, 'the page')
    corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0)]

    def draw(points):
        tab.page.locator('[data-mode=keep_out]').click()
        for point in points:
            tab.page.mouse.click(*tab.place_on_screen(*point))

    draw([(-2.0, -2.0), *corners])
    tab.page.keyboard.press('Escape')
    assert not tab.page.locator('#done').is_visible()
    tab.page.locator('[data-mode=initial_pose]').click()
    tab.page.mouse.move(*tab.place_on_screen(0.5, 0.5))
    tab.page.mouse.down()
    tab.page.keyboard.press('Escape')
    tab.page.mouse.up()
    # Two fingers zoom, and draw no corner.
    draw(corners[:1])
    tab.page.evaluate(PINCH)
    for point in corners[1:]:
        tab.page.mouse.click(*tab.place_on_screen(*point))
    tab.page.locator('#done').click()
    tab.until(lambda: areas and areas[-1].areas, 'the area')
    (area,) = areas[-1].areas
    assert np.array(drawn_corners(area)) == pytest.approx(np.array(corners), abs=CELL_M)
    tab.page.get_by_role('button', name='Remove').click()
    tab.until(lambda: not areas[-1].areas, 'no area')
    assert not poses
    assert not tab.errors


def drawn_corners(area):
    return [(point.x, point.y) for point in area.corners.points]


def test_a_button_is_for_what_can_be_done_and_asks_before_something_is_lost(graph, browser):
    graph.start('web', port=0, save_directory='maps')
    tab = Tab(graph, browser, address_of(graph))
    moving = ('explore', 'go', 'home')
    tab.until(tab.is_live, 'the page')
    tab.until(lambda: all(tab.is_disabled(name) for name in moving), 'nothing that drives')
    title = tab.page.locator('[data-mode=goal]').get_attribute('title')
    assert title == 'no server of navigate_to_pose: expected navigator to run'
    assert tab.is_disabled('cancel') and tab.is_disabled('pause')
    assert not tab.page.locator('#resume').is_visible()

    (graph.folder / 'maps').mkdir()
    save_grid(
        str(graph.folder / 'maps' / 'room'),
        OccupancyGrid.from_patch(driven_piece(1, 1).piece.patch),
    )
    graph.start('grid_mapper', save_directory='maps')
    tab.page.locator('#name').fill('room')
    tab.until(lambda: not tab.is_disabled('save'), 'a mapper')
    assert tab.is_disabled('load'), 'it is not known yet'
    tab.page.reload()
    tab.page.locator('#name').fill('room')
    tab.until(lambda: not tab.is_disabled('load'), 'the name of a session')
    for question in ('save', 'load'):
        tab.page.locator(f'#{question}').click()
        assert 'room' in tab.text('sure')
        tab.page.locator('#sure-no').click()
        assert not tab.page.locator('#sure').is_visible()
    tab.page.locator('#load').click()
    tab.page.get_by_role('button', name='Load', exact=True).first.click()
    tab.until(lambda: tab.event().startswith('load: '), 'the map of the session')
    tab.until(lambda: tab.item('map'), 'the map')
    tab.page.get_by_label('graph', exact=True).uncheck()
    assert tab.page.evaluate("thinmap.view.hidden.has('graph')")

    assert graph.stop('web', signal.SIGKILL) == -signal.SIGKILL
    tab.until(lambda: 'lost' in tab.text('status'), 'the page says that the link is lost')
    assert tab.page.locator('body.old').count() and tab.is_disabled('save')
    assert 'OK' not in tab.text('status')
    tab.errors.clear()  # of the link


def test_a_wrong_token_sees_nothing(graph, browser):
    graph.start('web', port=0, web_token_file='tokens')
    address = address_of(graph)
    tab = Tab(graph, browser, f'{address}#wrong')
    tab.until(lambda: tab.text('status') == 'wrong token', 'the refusal')
    assert tab.page.evaluate('thinmap.items.size') == 0
    watch = re.search(r'to watch: (\S+)', graph.log('web'))[1]
    watcher = Tab(graph, browser, watch)
    watcher.until(watcher.is_live, 'the page')
    assert not watcher.page.locator('#stop').is_visible()
    assert not tab.errors and not watcher.errors
