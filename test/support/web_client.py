"""A page without a browser: a web socket that keeps what it receives."""

import asyncio
import json
import threading
import time

from support.timeouts import PATIENCE_S
from tornado.httpclient import HTTPRequest
from tornado.websocket import websocket_connect

_LATE = 's late: nothing is done'


class WebClient:
    """A socket of a page, in a thread of its own.

    items: the newest value of each item; news: all that was told; refusals: errors that were shown
    here; opened, then closed: events; bytes: received so far. Each request says the newest beat,
    as those of the page do; one that a busy machine delays too long is asked again, as by a person.
    """

    def __init__(self, port, token='', origin=None, host='127.0.0.1'):
        self.items = {}
        self.news = []
        self.refusals = []
        self.opened = threading.Event()
        self.closed = threading.Event()
        self.bytes = 0
        self.error = None
        headers = {} if origin is None else {'Origin': origin}
        self._request = HTTPRequest(f'ws://{host}:{port}/socket', headers=headers)
        self._token = token
        self._loop = asyncio.new_event_loop()
        self._socket = None
        self._asked = {}
        threading.Thread(target=self._run, daemon=True).start()
        assert self.opened.wait(PATIENCE_S)

    def _run(self):
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._receive())
        finally:
            self.opened.set()
            self.closed.set()

    async def _receive(self):
        try:
            self._socket = await websocket_connect(self._request)
        except Exception as error:
            self.error = error
            return
        if self._token is not None:
            await self._socket.write_message(json.dumps({'token': self._token}))
        self.opened.set()
        while (text := await self._socket.read_message()) is not None:
            self.bytes += len(text)
            for name, value in json.loads(text):
                if name == 'refused' and _LATE in value and value.split(':')[0] in self._asked:
                    self.ask(value.split(':')[0], **self._asked[value.split(':')[0]])
                elif name == 'refused':
                    self.refusals.append(value)
                else:
                    self.items[name] = value
                    self.news = [text for _, text in value] if name == 'news' else self.news

    def send_text(self, text):
        self._loop.call_soon_threadsafe(self._write, text)

    def send_at_once(self, texts):
        """Send messages as a link does that has held them back."""
        self._loop.call_soon_threadsafe(lambda: [self._write(text) for text in texts])

    def _write(self, text):
        # What a socket that was closed says of it, nobody asks for.
        done = asyncio.ensure_future(self._send(text))
        done.add_done_callback(lambda future: future.exception())

    async def _send(self, text):
        await self._socket.write_message(text, binary=isinstance(text, bytes))

    def ask(self, action, **values):
        # First: the answer may come before anything that follows.
        self._asked[action] = values
        self._ask(self.items.get('beat'), action, **values)

    def ask_at(self, beat, action, **values):
        """Ask as a page that has heard nothing since a beat, once."""
        self._asked.pop(action, None)
        self._ask(beat, action, **values)

    def _ask(self, beat, action, **values):
        heard = {} if beat is None else {'beat': beat}
        self.send_text(json.dumps({'action': action, **heard, **values}))

    def close(self):
        if self._socket is not None and not self.closed.is_set():
            self._loop.call_soon_threadsafe(self._socket.close)
        assert self.closed.wait(PATIENCE_S)

    def drop(self):
        """Close the connection without a word, as a machine that is switched off."""
        self._loop.call_soon_threadsafe(self._socket.protocol.stream.close)

    def until(self, condition, what):
        """Wait without spinning a graph."""
        end = time.monotonic() + PATIENCE_S
        while not condition():
            reason = f'{what}: closed: {self.refusals}' if self.closed.is_set() else what
            assert time.monotonic() < end, f'never came: {reason}'
            time.sleep(0.01)
