"""What the server answers: the files of the page, and a socket for each page."""

import asyncio
import json
from importlib.resources import files
from typing import Any

from tornado.http1connection import HTTP1ServerConnection
from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream, StreamClosedError
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from thinmap_ros.core.errors import InputError
from thinmap_ros.web.access import Role
from thinmap_ros.web.pages import MAX_PAGES, Pages, PageState, role_of
from thinmap_ros.web.requests import MAX_MESSAGE_BYTES, parse

_PING_S = 5.0
_REFUSED = 1008
_AGAIN = 1013  # the page connects again
# Connections that are no socket of a page (yet), and the time that they have to ask for something.
MAX_CONNECTIONS = 64
_HEADERS_S = 5.0
_TYPES = {
    'html': 'text/html',
    'js': 'text/javascript',
    'css': 'text/css',
    'svg': 'image/svg+xml',
}
_HEADERS = {
    'Content-Security-Policy': "default-src 'self'; frame-ancestors 'none'; base-uri 'none'",
    'X-Content-Type-Options': 'nosniff',
    'Referrer-Policy': 'no-referrer',
    'Cache-Control': 'no-store',
}


class File(RequestHandler):
    """A file of the page, which holds no data of the robot."""

    def initialize(self, pages: Pages, content: bytes, kind: str) -> None:
        """Take what the rule of the address says."""
        self._pages = pages
        self._content = content
        self._kind = kind

    def set_default_headers(self) -> None:
        """Nothing of others is loaded, and no page of others holds this one."""
        for name, value in _HEADERS.items():
            self.set_header(name, value)
        self.clear_header('Server')

    def get(self) -> None:
        """Send the file."""
        if not self._pages.gate.allows_host(self.request.host):
            raise HTTPError(403)
        self.set_header('Content-Type', f'{self._kind}; charset=utf-8')
        self.finish(self._content)


class Page(WebSocketHandler):
    """A socket of a page: items to it, requests from it."""

    def initialize(self, pages: Pages) -> None:
        """Take what the rule of the address says."""
        self._pages = pages
        self._state = PageState()

    def check_origin(self, origin: str) -> bool:
        """Checked by `prepare`, together with the host."""
        return True

    def prepare(self) -> None:
        """Refuse pages of others, before the socket is opened."""
        gate = self._pages.gate
        host = self.request.host
        origin = self.request.headers.get('Origin')
        if not gate.allows_host(host) or not gate.allows_origin(origin, host):
            raise HTTPError(403)

    @property
    def role(self) -> Role | None:
        """What the page may do; None: it has not said a token."""
        return self._state.role

    @property
    def number(self) -> int:
        """Of the page, in the order of opening."""
        return self._state.number

    def open(self, *args: str, **kwargs: str) -> None:
        """Begin; nothing is sent before the token is known."""
        self.set_nodelay(True)
        self._state.number = self._pages.new_number()
        self._pages.add(self)

    def drop(self) -> None:
        """Close the connection at once, without a word."""
        self.on_close()
        stream = self.ws_connection.stream if self.ws_connection else None
        if stream is not None:
            stream.close()

    def on_message(self, message: str | bytes) -> None:
        """Take the token, and then requests."""
        if self._state.role is None:
            self._on_hello(message)
        else:
            self._on_request(message)

    def _on_hello(self, message: str | bytes) -> None:
        role = role_of(message, self._pages.gate)
        if role is None:
            self.close(_REFUSED, 'wrong token')
            return
        if not self._pages.has_place(role):
            self.close(_AGAIN, f'{MAX_PAGES} pages to {role.value} are open')
            return
        self._state.role = role
        self._say('hello', {'role': role.value})

    def _on_request(self, message: str | bytes) -> None:
        is_within_rate = self._state.is_within_rate()
        if not is_within_rate:
            self.close(_AGAIN, 'too many messages')
        try:
            request = parse(message)
            # A link that was cut brings all at once: the last of it may be a stop.
            if not is_within_rate and request.action != 'stop':
                return
            if self._state.role is not Role.STEER:
                raise InputError(f'{request.action}: this link is for watching only')
            request.require_recent()
            self._pages.robot.requested(self._state.number, request)
        except InputError as error:
            self._say('refused', str(error))

    def _say(self, name: str, value: Any) -> None:
        self._saying = asyncio.ensure_future(self._write(json.dumps([[name, value]])))

    def send(self, encoded: dict[int, tuple[int, str]]) -> None:
        """Send what has changed; encoded: what others have been sent since the same change."""
        state = self._state
        if state.role is None or state.is_stuck():
            if state.is_overdue():
                self.close(_AGAIN if state.role else _REFUSED, 'no answer')
            return
        if state.change not in encoded:
            encoded[state.change] = self._pages.board.since(state.change)
        state.change, text = encoded[state.change]
        if text:
            state.sent(asyncio.ensure_future(self._write(text)))

    async def _write(self, text: str) -> None:
        try:
            await self.write_message(text)
        except (WebSocketClosedError, StreamClosedError):
            self.on_close()

    def on_close(self) -> None:
        """Forget the page, and stop what it drives."""
        if self in self._pages.open:
            self._pages.open.discard(self)
            self._pages.robot.page_closed(self._state.number)


class LimitedServer(HTTPServer):
    """Closes connections that ask for nothing: in time, and of too many the oldest.

    Who asks does so at once, and so gets in between any number of connections that say nothing.
    Sockets of pages do not count: `Pages` has the limits of these.
    """

    def initialize(self, pages: Pages) -> None:  # type: ignore[override]
        """Serve the files of the page, and its socket."""
        super().initialize(
            application(pages),
            max_body_size=0,
            max_header_size=MAX_MESSAGE_BYTES,
            idle_connection_timeout=_HEADERS_S,
        )
        self._asking: dict[IOStream, None] = {}  # oldest first

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        """Take a connection."""
        while len(self._asking) >= MAX_CONNECTIONS:
            oldest = next(iter(self._asking))
            del self._asking[oldest]
            oldest.close()
        self._asking[stream] = None
        super().handle_stream(stream, address)

    def on_close(self, server_conn: object) -> None:
        """Forget a connection: it is closed, or the socket of a page."""
        super().on_close(server_conn)
        if isinstance(server_conn, HTTP1ServerConnection):
            self._asking.pop(server_conn.stream, None)


def application(pages: Pages) -> Application:
    """The files of the page, and its socket."""
    rules: list[Any] = [(r'/socket', Page, {'pages': pages})]
    for file in (files('thinmap_ros.web') / 'page').iterdir():
        name, _, ending = file.name.rpartition('.')
        if ending in _TYPES:
            path = r'/' if file.name == 'index.html' else rf'/{name}\.{ending}'
            content = {'content': file.read_bytes(), 'kind': _TYPES[ending]}
            rules.append((path, File, {'pages': pages, **content}))
    return Application(
        rules,
        websocket_max_message_size=MAX_MESSAGE_BYTES,
        websocket_ping_interval=_PING_S,
        websocket_ping_timeout=_PING_S,
        log_function=lambda handler: None,
    )
