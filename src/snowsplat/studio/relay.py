"""Passes the connection of the page of a running training on, with its images.

The job listens at a port of its own, on the loopback interface. Browsers of the studio may be
elsewhere, so that they reach the studio only. The files of the page are those of the studio.
"""

import asyncio
from contextlib import suppress

from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

_SECONDS = 20.0  # to answer; a training step may block the process


async def relay_socket(browser: WebSocket, url: str) -> None:
    """Connect a browser with the WebSocket of the page at ``url``, until one of them ends it.

    A message is read when the one before it is sent, so that neither can flood the other.
    """
    address = f"{url.replace('http', 'ws', 1)}live"
    await browser.accept()
    try:
        async with connect(
            address, max_size=None, compression=None, proxy=None, open_timeout=_SECONDS
        ) as page:
            ways = [
                asyncio.ensure_future(way) for way in (_to(page, browser), _from(page, browser))
            ]
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)
    except (OSError, TimeoutError, WebSocketException):
        pass  # the training has just ended
    with suppress(RuntimeError, WebSocketDisconnect):  # the browser has ended it
        await browser.close()


async def _to(page: ClientConnection, browser: WebSocket) -> None:
    while (message := await browser.receive())["type"] == "websocket.receive":
        data = message.get("bytes")
        await page.send(message["text"] if data is None else data)


async def _from(page: ClientConnection, browser: WebSocket) -> None:
    async for message in page:
        if isinstance(message, bytes):
            await browser.send_bytes(message)
        else:
            await browser.send_text(message)
