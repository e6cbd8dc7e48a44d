"""The server with real sockets: who sees what, what is passed on, and what is closed."""

import contextlib
import http.client
import json
import re
import socket
import time

import pytest
from support.timeouts import PATIENCE_S
from support.web_client import WebClient

from thinmap_ros.core.errors import InputError
from thinmap_ros.web import handlers, pages
from thinmap_ros.web.access import Gate, Role, Tokens
from thinmap_ros.web.pages import MAX_PAGES, MAX_STRANGERS, Board, Pages
from thinmap_ros.web.requests import beat
from thinmap_ros.web.server import Address, Server

TOKENS = Tokens('s' * 20, 'w' * 20)

# A web socket that says no token yet.
HELLO = (
    b'GET /socket HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n'
    b'Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n'
)


class Taken:
    """What pages asked for."""

    def __init__(self):
        self.requests = []
        self.gone = []

    def requested(self, page, request):
        if request.action == 'load':
            raise InputError('load: not now')
        self.requests.append((page, request.action))

    def page_closed(self, page):
        self.gone.append(page)


class Site:
    """A server, and the pages of a test."""

    def __init__(self, tokens=None):
        self.board = Board()
        self.robot = Taken()
        self.pages = Pages(self.board, Gate(tokens), self.robot)
        self.server = Server(Address('127.0.0.1', 0), self.pages)
        self.port = int(re.search(r':(\d+)/', self.server.url)[1])
        self.clients = []

    def open(self, **settings):
        self.clients.append(WebClient(self.port, **settings))
        return self.clients[-1]

    def connect(self, text=b''):
        stream = socket.create_connection(('127.0.0.1', self.port), timeout=PATIENCE_S)
        stream.sendall(text)
        return stream

    def get(self, path, host=None, method='GET', body=None):
        connection = http.client.HTTPConnection('127.0.0.1', self.port, timeout=PATIENCE_S)
        headers = {} if host is None else {'Host': host}
        connection.request(method, path, body=body, headers=headers)
        answer = connection.getresponse()
        try:
            return answer, answer.read()
        except ConnectionResetError:  # a body that is refused unread resets the connection
            if body is None:
                raise
            return answer, b''


@pytest.fixture
def site():
    made = []

    def make(tokens=None):
        made.append(Site(tokens))
        return made[-1]

    yield make
    for one in made:
        one.server.close()


@pytest.fixture
def patient(monkeypatch):
    """A server that closes nobody who is slow, as a test is on a busy machine."""
    limits = ((handlers, ('_HEADERS_S', '_PING_S')), (pages, ('_HELLO_S', '_STUCK_S')))
    for module, names in limits:
        for name in names:
            monkeypatch.setattr(module, name, PATIENCE_S)


def test_pages_see_what_is_shown_and_agree(site):
    one = site()
    one.board.put('robot', 1)
    first = one.open()
    second = one.open()
    for page in (first, second):
        page.until(lambda page=page: page.items.get('robot') == 1, 'the robot')
    one.board.put('robot', 2)
    for page in (first, second):
        page.until(lambda page=page: page.items.get('robot') == 2, 'the robot of later')
    first.ask('stop')
    first.until(lambda: one.robot.requests, 'the stop')
    assert one.robot.requests == [(1, 'stop')]
    second.close()
    first.until(lambda: one.robot.gone == [2], 'the end of a page')
    first.drop()
    first.until(lambda: one.robot.gone == [2, 1], 'the end of a page without a word')


def test_a_request_that_cannot_be_done_is_answered_to_its_page_alone(site):
    one = site()
    first = one.open()
    second = one.open()
    first.ask('load', name='x')
    first.ask('goal', x='here')
    first.until(lambda: len(first.refusals) == 2, 'two refusals')
    assert first.refusals[0] == 'load: not now' and 'expected x, y, theta' in first.refusals[1]
    assert not second.refusals and not one.robot.requests


@pytest.mark.parametrize('token', ['', 'x', 'S' * 20, 's' * 19, '\x00' * 5000, 7, None])
def test_a_wrong_token_sees_nothing(site, token):
    one = site(TOKENS)
    one.board.put('robot', 1)
    page = one.open(token=token)
    if token is None:  # it says nothing, and then asks at once
        page.ask('stop')
    assert page.closed.wait(PATIENCE_S)
    assert not page.items and not one.robot.requests


def test_a_link_to_watch_shows_all_and_does_nothing(site):
    one = site(TOKENS)
    one.board.put('robot', 1)
    watcher = one.open(token=TOKENS.watch)
    watcher.until(lambda: 'robot' in watcher.items, 'the robot')
    assert watcher.items['hello'] == {'role': 'watch'}
    for action in ('stop', 'pause', 'cancel'):
        watcher.ask(action)
    watcher.until(lambda: len(watcher.refusals) == 3, 'refusals')
    assert all('watching only' in text for text in watcher.refusals) and not one.robot.requests
    driver = one.open(token=TOKENS.steer)
    driver.ask('stop')
    driver.until(lambda: one.robot.requests, 'the stop')


def test_on_this_machine_a_page_may_ask_to_watch_only(site):
    one = site()
    page = one.open(token='watch')
    page.until(lambda: 'hello' in page.items, 'the answer')
    assert page.items['hello'] == {'role': 'watch'}


def test_pages_and_names_of_others_are_refused(site):
    one = site()
    one.board.put('robot', 1)
    for origin in ('http://evil.example', 'null', f'http://127.0.0.1:{one.port + 1}'):
        page = one.open(origin=origin)
        assert '403' in str(page.error) and not page.items
    assert one.open(origin=f'http://127.0.0.1:{one.port}').error is None
    assert one.get('/', host='evil.example')[0].status == 403
    assert one.get('/socket', host='evil.example')[0].status == 403


def test_the_files_of_the_page_and_no_others(site):
    one = site()
    answer, text = one.get('/')
    assert answer.status == 200 and b'<canvas' in text
    assert "default-src 'self'" in answer.headers['Content-Security-Policy']
    assert answer.headers['Content-Type'].startswith('text/html')
    for name in re.findall(rb'(?:src|href)="([^"]+)"', text):
        assert one.get('/' + name.decode())[0].status == 200
    for path in (
        '/page/',
        '/../access.py',
        '/%2e%2e/access.py',
        '/index.html/',
        '/server.py',
        '//',
    ):
        assert one.get(path)[0].status in (403, 404)
    assert one.get('/', method='POST')[0].status == 405
    assert one.get('/', method='PUT', body=b'x' * 10)[0].status in (400, 413)


def test_too_many_messages_too_long_ones_and_too_many_pages_are_ended(site):
    one = site()
    fast = one.open()
    for _ in range(300):
        fast.ask('cancel')
    assert fast.closed.wait(PATIENCE_S) and len(one.robot.requests) <= 100
    long = one.open()
    long.send_text('x' * 100_000)
    assert long.closed.wait(PATIENCE_S)
    fast.until(lambda: not one.pages.open, 'no page')
    opened = [one.open() for _ in range(MAX_PAGES)]
    for page in opened:
        page.until(lambda page=page: 'hello' in page.items, 'the answer')
    assert one.open().closed.wait(PATIENCE_S) and not one.pages.has_place(Role.STEER)
    assert all(not page.closed.is_set() for page in opened)
    opened[0].close()
    opened[1].until(lambda: one.pages.has_place(Role.STEER), 'room for a page')
    late = one.open()
    late.until(lambda: 'hello' in late.items, 'the answer')


@pytest.mark.usefixtures('patient')
def test_a_page_that_takes_nothing_does_not_fill_the_memory(site):
    """What is not yet sent is one message; what changes meanwhile is sent once, as it is then."""
    one = site()
    slow = one.connect(HELLO)
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    hello = json.dumps({'token': ''}).encode()
    mask = b'\x00\x00\x00\x00'
    slow.sendall(bytes([0x81, 0x80 | len(hello)]) + mask + hello)
    quick = one.open()
    for number in range(8):
        one.board.put('large', [number, 'x' * 8_000_000])
        quick.until(lambda n=number: quick.items.get('large', [-1])[0] == n, 'the large item')

    def stuck_pages():
        return [page for page in one.pages.open if page._state.is_stuck()]

    # The server hears after the quick page that this has taken the last one.
    quick.until(lambda: len(stuck_pages()) == 1, 'one stuck page')
    (stuck,) = stuck_pages()
    assert len(stuck.ws_connection.stream._write_buffer) < 20_000_000
    slow.close()


def test_an_address_that_is_taken_is_one_clear_line(site):
    one = site()
    with pytest.raises(InputError, match=f'127.0.0.1:{one.port}: .*in use'):
        Server(Address('127.0.0.1', one.port), one.pages)


def test_a_link_that_is_late_moves_nothing_and_stops_all(site):
    one = site()
    page = one.open()
    page.until(lambda: page.items.get('beat', 0) > 0, 'a beat')
    old = page.items['beat'] - 600
    page.ask_at(old, 'drive', ahead=1.0, left=0.0)
    page.ask_at(old - 1500, 'goal', x=1.0, y=1.0, theta=0.0)
    page.ask_at(beat() + 60_000, 'home')
    page.ask_at(None, 'resume')
    page.until(lambda: len(page.refusals) == 4, 'four refusals')
    assert 's late: nothing is done' in page.refusals[0]
    assert 's late: nothing is done' in page.refusals[1]
    assert not one.robot.requests
    page.ask_at(old, 'drive', ahead=0.0, left=0.0)
    page.ask_at(old, 'stop')
    page.ask('home')
    page.until(lambda: len(one.robot.requests) == 3, 'what is in time')
    assert [action for _, action in one.robot.requests] == ['drive', 'stop', 'home']
    first = page.items['beat']
    page.until(lambda: page.items['beat'] > first, 'a later beat')


def test_a_stop_at_the_end_of_what_a_cut_has_held_back_is_heard(site):
    one = site()
    page = one.open()
    page.until(lambda: 'beat' in page.items, 'a beat')
    late = {'action': 'drive', 'beat': page.items['beat'] - 600, 'ahead': 1.0, 'left': 0.0}
    page.send_at_once([*[json.dumps(late)] * 200, json.dumps({'action': 'stop'})])
    page.until(lambda: one.robot.requests, 'the stop')
    assert one.robot.requests == [(1, 'stop')]


@pytest.mark.usefixtures('patient')
@pytest.mark.parametrize('text', [b'', b'GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n', HELLO])
def test_connections_that_say_no_token_keep_nobody_out(site, text):
    """Whatever they wait with, the oldest is closed for the newest."""
    one = site(TOKENS)
    limit = MAX_STRANGERS if text == HELLO else handlers.MAX_CONNECTIONS
    first = one.open(token=TOKENS.steer)
    first.until(lambda: 'hello' in first.items, 'a page of before')
    idle = [one.connect(text) for _ in range(3 * limit)]
    page = one.open(token=TOKENS.steer)
    page.until(lambda: 'hello' in page.items, 'a page between them')
    assert one.get('/')[0].status == 200
    for stream in idle[: 2 * limit - 2]:
        with contextlib.suppress(ConnectionResetError):
            while stream.recv(4096):
                pass  # the answer to a hello
    idle[-1].settimeout(0.0)
    with pytest.raises(BlockingIOError):
        while idle[-1].recv(4096):
            pass
    assert len(one.pages.open) <= MAX_STRANGERS + 2
    page.ask('stop')
    first.until(lambda: one.robot.requests, 'a stop')
    assert not first.closed.is_set()
    for stream in idle:
        stream.close()


def test_headers_that_come_slowly_have_an_end(site, monkeypatch):
    monkeypatch.setattr(handlers, '_HEADERS_S', 0.3)
    slow = site().connect(b'GET / HTTP/1.1\r\n')
    end = time.monotonic() + PATIENCE_S
    with pytest.raises(OSError, match=r'reset|pipe'):
        while time.monotonic() < end:
            slow.sendall(b'X: y\r\n')
            time.sleep(0.02)


def test_who_watches_takes_no_place_of_those_who_steer(site):
    one = site(TOKENS)
    for _ in range(MAX_PAGES):
        page = one.open(token=TOKENS.watch)
        page.until(lambda page=page: 'hello' in page.items, 'the answer')
    assert one.open(token=TOKENS.watch).closed.wait(PATIENCE_S)
    driver = one.open(token=TOKENS.steer)
    driver.ask('stop')
    driver.until(lambda: one.robot.requests, 'the stop')


def test_a_flood_of_wrong_tokens_keeps_nobody_out(site):
    one = site(TOKENS)
    guessers = [one.connect(HELLO) for _ in range(2 * MAX_STRANGERS)]
    guess = json.dumps({'token': 'x' * 20}).encode()
    for stream in guessers:
        # Of those closed before: nothing is left to say.
        with contextlib.suppress(OSError):
            stream.sendall(bytes([0x81, 0x80 | len(guess)]) + b'\x00' * 4 + guess)
    page = one.open(token=TOKENS.steer)
    page.until(lambda: 'hello' in page.items, 'a page')
    for stream in guessers:
        stream.close()
