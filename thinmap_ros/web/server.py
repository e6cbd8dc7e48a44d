"""HTTP and web socket server of the page, in a thread of its own. Tornado is the extra `web`."""

import asyncio
import logging
from dataclasses import dataclass
from threading import Event, Thread

from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.web.pages import Pages

_START_S = 10.0


@dataclass(frozen=True)
class Address:
    """Where the server listens."""

    host: str
    port: int

    @property
    def url(self) -> str:
        """Of the page."""
        host = f'[{self.host}]' if ':' in self.host else self.host
        return f'http://{host}:{self.port}/'


class Server:
    """Serves the page until it is closed.

    port: that of the machine where it was asked for any, 0; url: of the page.
    """

    def __init__(self, address: Address, pages: Pages) -> None:
        """Raises InputError where the address cannot be used, or tornado is missing."""
        try:
            import tornado.websocket  # noqa: F401
        except ImportError as error:
            raise InputError('tornado is not installed: pip install tornado') from error
        # Tornado's lines about closed sockets are no news here.
        logging.getLogger('tornado').setLevel(logging.CRITICAL)
        self._pages = pages
        self._started = Event()
        self._fault = ''
        self.port = address.port
        self.url = ''
        self._loop = asyncio.new_event_loop()
        self._thread = Thread(target=self._run, args=(address,), daemon=True)
        self._thread.start()
        self._started.wait(_START_S)
        if self._fault:
            raise InputError(f'{address.host}:{address.port}: {self._fault}')

    def close(self) -> None:
        """Close all pages and the server."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def _run(self, address: Address) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._listen(address))
        except OSError as error:
            self._fault = one_line_reason(error)
            self._started.set()
            return
        sender = self._loop.create_task(self._pages.send_for_ever())
        self._started.set()
        self._loop.run_forever()
        sender.cancel()
        for page in list(self._pages.open):
            page.on_close()

    async def _listen(self, address: Address) -> None:
        from tornado.netutil import bind_sockets

        from thinmap_ros.web.handlers import LimitedServer

        server = LimitedServer(self._pages)
        sockets = bind_sockets(address.port, address.host)
        server.add_sockets(sockets)
        self.port = int(sockets[0].getsockname()[1])
        self.url = Address(address.host, self.port).url
