"""`WebServer`: serves an ASGI app to the browsers of one user, behind a `Guard`.

uvicorn's protocols parse the requests. Its server is not used: that one is made for a process of
its own, with signal handlers, and checks several times per second whether it should end.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from starlette.types import ASGIApp
from uvicorn.config import Config
from uvicorn.server import ServerState

from snowsplat.viewer.hosts import ANY_HOST, BACKLOG, KnownHosts, listen
from snowsplat.viewer.http.guard import HEAD_SIZE, MESSAGE_SIZE, Connection, Guard

_IDLE_SECONDS = 60  # after which a connection without a further request is closed

_log = logging.getLogger(__name__)


class WebServer:
    """Serves ``app`` in a thread of its own, from its creation until `close`.

    All paths begin with a secret token, which ``app`` does not see. Every response has the
    additional ``headers``, unless the app sets them. ``port``: see `listen`. ``allow_host``: names
    of proxies; see `KnownHosts`.
    Raises: UserError: the port is in use or not permitted, or the host is not an address of this
    machine; or an allowed name is none.
    """

    def __init__(
        self,
        app: ASGIApp,
        host: str = "127.0.0.1",
        port: int | None = 0,
        allow_host: Sequence[str] = (),
        headers: Mapping[str, str] | None = None,
    ) -> None:
        hosts = KnownHosts(host, allow_host)
        self.host = host
        self.token = secrets.token_urlsafe(16)
        self._guard = Guard(app, hosts, self.token, headers or {})
        self._socket = listen(host, port)
        self.port: int = self._socket.getsockname()[1]
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(_log_error)
        self._closing = asyncio.Event()
        self.thread = threading.Thread(target=self._run, name="web server", daemon=True)
        self.thread.start()

    @property
    def url(self) -> str:
        """The URL of the page, for a browser on this machine."""
        return self.url_at("127.0.0.1" if self.host in ANY_HOST else self.host)

    @property
    def others(self) -> list[str]:
        """The URLs of the page for browsers on other machines, if they differ from `url`."""
        named = [self.url_at(socket.gethostname())] if self.host in ANY_HOST else []
        return named + [f"https://{name}/{self.token}/" for name in self._guard.hosts.allowed]

    def url_at(self, host: str) -> str:
        """The URL of the page if this machine is called ``host``."""
        place = f"[{host}]" if ":" in host else host
        return f"http://{place}:{self.port}/{self.token}/"

    def call(self, run: Callable[..., object], *args: Any) -> None:
        """Schedule a call in the thread of the server; does nothing if the server has stopped."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(run, *args)

    def close(self) -> None:
        """Stop the server; running downloads are aborted."""
        self.call(self._closing.set)
        self.thread.join()

    def __enter__(self) -> WebServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self) -> None:
        config = Config(
            self._guard,
            ws="websockets-sansio",
            interface="asgi3",
            lifespan="off",
            proxy_headers=False,
            log_config=None,
            log_level=logging.CRITICAL + 1,  # uvicorn logs each malformed request
            access_log=False,
            timeout_keep_alive=_IDLE_SECONDS,
            h11_max_incomplete_event_size=HEAD_SIZE,
            ws_max_size=MESSAGE_SIZE,
            ws_per_message_deflate=False,
        )
        config.load()
        state = ServerState()
        server = await self._loop.create_server(
            lambda: Connection(config, state, {}, self._loop),
            sock=self._socket,
            backlog=BACKLOG,
        )
        await self._closing.wait()
        server.close()
        for connection in state.connections:
            connection.transport.abort()
        for task in state.tasks:
            task.cancel()
        await asyncio.gather(*state.tasks, return_exceptions=True)
        await asyncio.sleep(0)  # closes the sockets of aborted connections


def _log_error(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    _log.debug("%s", context.get("message"), exc_info=context.get("exception"))
