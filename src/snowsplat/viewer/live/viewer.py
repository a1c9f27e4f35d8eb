"""`NetworkViewer`: a page for any number of browsers, and the images that they request."""

import asyncio
import html
import itertools
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket

from snowsplat.data import Dataset
from snowsplat.scene.camera_json import entries_of
from snowsplat.scene.gaussians import Gaussians
from snowsplat.trajectory.focus import focus_of, up_of, viewing_distance
from snowsplat.util import messages
from snowsplat.util.errors import UserError
from snowsplat.viewer.http.server import WebServer
from snowsplat.viewer.http.static import FileOnDisk, Served, ServedFile, content_type, static_app
from snowsplat.viewer.live.browser import (
    Browser,
    Key,
    Message,
    Share,
    Shown,
    Thumbnails,
    Training,
    to_json,
)
from snowsplat.viewer.live.page_files import FILES, INDEX, POLICY
from snowsplat.viewer.live.photos import Photos, fitted_photo, jpeg
from snowsplat.viewer.live.pictures import Display, View, draw
from snowsplat.viewer.live.session import RenderRequest, Session

_QUALITY = {"moving": 60, "still": 90, "idle": 90}  # of JPEG images
_TICK = 0.02  # seconds between two checks for requested images
_LONG_TICK = 0.5  # the same without browsers
_POLL = 2.0  # seconds between two checks for a newer scene
_TITLE = "<title>snowsplat</title>"

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Scene:
    """The scene to show.

    Attributes:
        gaussians: None if there are none yet.
        number: changes when the Gaussians change.
        about: lines of text for the user.
    """

    gaussians: Gaussians | None
    number: int
    about: Sequence[messages.Message]


class NetworkViewer:
    """A page at `url` that shows Gaussians.

    Attributes:
        others: the addresses of the page for other machines, if they differ from `url`.

    Images are rendered only in the thread that calls `serve` or `show_newest`. So the Gaussians do
    not change during rendering, and no copy of them is needed.
    """

    def __init__(
        self,
        dataset: Dataset,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        *,
        host: str = "127.0.0.1",
        port: int | None = None,
        label: str = "snowsplat",
        allow_host: Sequence[str] = (),
    ) -> None:
        """
        Args:
            dataset: its cameras and photos are shown in the scene.
            background: the colour behind the Gaussians, 0..1.
            host: address at which to listen.
            port: None takes 8080, or the next free port.
            label: title of the page.
            allow_host: names of proxies; see `snowsplat.viewer.hosts.KnownHosts`.

        Raises:
            UserError: the port is in use, or the host is not an address of this machine.
        """
        self.session = Session()
        self.background = torch.tensor(background, dtype=torch.float32)
        views = [*dataset.train, *dataset.test]
        self._near = views[0].camera.near
        self._photos = Photos(
            self.session, dataset.train, dataset.test, dataset.extent, self.background
        )
        self._told: dict[str, str] = {}  # the newest messages for all browsers, by type
        self._training: dict[str, Any] = {}  # the newest one about the training
        self._browsers: set[Browser] = set()
        self._numbers = itertools.count()  # of browsers
        cameras = [view.camera for view in views]
        points = torch.zeros(0, 3) if dataset.points is None else dataset.points.xyz
        focus = focus_of(cameras, viewing_distance(cameras, points))
        self._tell(
            {
                "type": "scene",
                "title": label,
                "up": up_of(cameras).tolist(),
                "focus": focus.tolist(),
                "bounds": dataset.bounds.tolist(),
                "extent": dataset.extent,
                **self._photos.description(),
            }
        )
        policy = {"Content-Security-Policy": POLICY}
        self.server = WebServer(self._app(label), host, port, allow_host, policy)
        self.url, self.others = self.server.url, self.server.others

    def close(self) -> None:
        """Close the page."""
        self._photos.close()
        self.server.close()

    def _app(self, label: str) -> ASGIApp:
        """What the server serves: the files of the page, and the connections of browsers."""
        files: dict[str, Served] = {
            name: FileOnDisk(file, content_type(file)) for name, file in FILES.items()
        }
        title = f"<title>{html.escape(label)} - snowsplat</title>"
        page = FILES[INDEX].read_text("utf-8").replace(_TITLE, title, 1)
        files[""] = ServedFile(page.encode(), "text/html; charset=utf-8")
        page_app = static_app(files)

        async def answer(scope: Scope, receive: Receive, send: Send) -> None:
            if scope["type"] == "websocket" and scope["path"] == "/live":
                await self._connected(WebSocket(scope, receive, send))
            else:
                await page_app(scope, receive, send)

        return answer

    def tell(self, message: dict[str, Any]) -> None:
        """Show a message to all browsers, present and future; its type is that of `page/main.js`.

        It replaces the last one of its type. May be called in any thread.
        """
        self.server.call(lambda: self._tell(message))

    # The following methods run in the server's thread. Events are processed in order, and the next
    # message is read only after the previous one is processed.

    def _tell(self, message: dict[str, Any]) -> None:
        kind, text = message["type"], to_json(message)
        if kind == "training":
            self._training = message
        self._told[kind] = text
        for browser in self._browsers:
            browser.tell(kind, text)

    def _tell_control(self) -> None:
        """Show at once what a browser has set."""
        if self._training:
            session = self.session
            self._tell({**self._training, "paused": session.paused, "share": session.share})

    async def _connected(self, socket: WebSocket) -> None:
        """Serve a browser until it disconnects."""
        number = next(self._numbers)
        browser = Browser(socket, self.session.enter(number), self._photos)
        self._browsers.add(browser)
        try:
            await socket.accept()
            for kind, text in self._told.items():
                browser.tell(kind, text)
            await browser.run(lambda message: self._take(browser, message))
        finally:
            self._browsers.discard(browser)
            self.session.leave(number)

    def _wake(self) -> None:
        for browser in self._browsers:
            browser.wake()

    def _take(self, browser: Browser, message: Message) -> None:
        """Process a message of a browser."""
        session, visitor = self.session, browser.visitor
        if isinstance(message, View):
            self._move(browser, message)
        elif isinstance(message, Shown):
            session.arrived(visitor, browser.arrived(message.number))
        elif isinstance(message, Thumbnails):
            self._photos.begin(lambda: self.server.call(self._wake))
            browser.want_thumbnails(message.count)
        elif isinstance(message, Display):
            session.change(visitor, display=message)
        elif isinstance(message, Key) and (view := visitor.view) is not None:
            camera = view.camera(view.width, view.height, self._near)
            browser.tell_key(entries_of([("", camera)])[0])
        elif isinstance(message, Training):
            {"pause": session.pause, "resume": session.resume, "step": session.step}[message.do]()
            self._tell_control()
        elif isinstance(message, Share):
            session.share = message.share
            self._tell_control()

    def _move(self, browser: Browser, view: View) -> None:
        if view.photo is not None and not 0 <= view.photo < len(self._photos.views):
            view = replace(view, photo=None)
        self.session.move(browser.visitor, view)
        if view.photo is not None and (browser.reading is None or browser.reading.done()):
            browser.reading = asyncio.create_task(self._read_photos(browser))

    async def _read_photos(self, browser: Browser) -> None:
        """Read the photo at which a browser is, and then the one at which it is meanwhile."""
        visitor, tried = browser.visitor, None
        while visitor.photo is not None and visitor.photo != tried:
            tried = visitor.photo
            if visitor.photo_view is not None:
                continue
            try:
                self.session.show_photo(visitor, await self._photos.read(tried))
            except UserError as error:
                why = error.message.in_all_languages()
                message = {"type": "photo", "index": tried, "error": why}
                browser.tell("photo", to_json(message))

    def _send(self, request: RenderRequest, image: np.ndarray, drawing: float) -> None:
        started = time.monotonic()
        browser = next((b for b in self._browsers if b.visitor is request.visitor), None)
        try:
            if browser is not None:  # None: the browser has disconnected
                browser.show(jpeg(image, _QUALITY[request.kind]), request.view.number)
        except Exception:
            self.session.arrived(request.visitor, 1)
            raise
        finally:
            self.session.record_sending(request, drawing + time.monotonic() - started)

    # The following methods run in the thread that trains or shows a scene

    def serve(self, gaussians: Gaussians, scene: int, *, training: bool) -> bool:
        """Render the most urgent image and send it; returns whether there was one.

        ``scene`` changes when the Gaussians change. If the ``training`` waits to continue, images
        are rendered only in their share of the time.
        """
        request = self.session.next_request(scene, training)
        if request is None:
            return False
        started = time.monotonic()
        try:
            image = self._draw(request, gaussians)
            self.session.begin_sending(request.visitor)
            seconds = time.monotonic() - started
            self.server.call(lambda: self._send(request, image, seconds))
        except Exception:  # an invalid request of a browser must not end the training
            _log.debug("an image was not rendered", exc_info=True)
        self.session.record_rendering(request, scene, time.monotonic() - started)
        return True

    def _draw(self, request: RenderRequest, gaussians: Gaussians) -> np.ndarray:
        width, height, photo = request.width, request.height, None
        if request.photo_view is None:
            camera = request.view.camera(width, height, self._near)
        else:
            photo = fitted_photo(request.photo_view, width, height)
            camera = photo.placed.camera(request.photo_view.camera, width, height)
        return draw(gaussians, camera, request.display, self.background, photo)

    def wait(self) -> None:
        """Wait for a change, or a fraction of a second."""
        self.session.wait(_TICK if self.session.visitors else _LONG_TICK)

    def show_newest(self, newest: Callable[[], Scene]) -> None:
        """Show the scene that ``newest`` returns, until Ctrl-C, which raises KeyboardInterrupt."""
        scene, checked = None, 0.0
        while True:
            if time.monotonic() - checked > _POLL:
                before, scene = scene, newest()
                checked = time.monotonic()
                if scene != before:
                    lines = [line.in_all_languages() for line in scene.about]
                    self.tell({"type": "about", "lines": lines})
            assert scene is not None
            if scene.gaussians is None or not self.serve(
                scene.gaussians, scene.number, training=False
            ):
                self.wait()
