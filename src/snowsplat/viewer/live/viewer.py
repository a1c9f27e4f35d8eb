"""`NetworkViewer`: a page for any number of browsers, and the images that they request."""

from __future__ import annotations

import asyncio
import functools
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import viser

from snowsplat.data import Dataset
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity
from snowsplat.scene.near_plane import NEAR
from snowsplat.viewer.live.controls import Controls, ScenePanel
from snowsplat.viewer.live.display import Pose
from snowsplat.viewer.live.guard import (
    Connection,
    ServerTimeLimit,
    call_in_server_thread,
    current_connection,
)
from snowsplat.viewer.live.key_cameras import KeyCameras
from snowsplat.viewer.live.photos import Photos, fitted_photo
from snowsplat.viewer.live.pictures import draw
from snowsplat.viewer.live.server import start_server, stop_server
from snowsplat.viewer.live.session import MOVE_SECONDS, RenderRequest, Session, Visitor
from snowsplat.viewer.live.shortcuts import Shortcuts, set_theme

_QUALITY = {"moving": 60, "still": 90, "idle": 90}  # of JPEG images
_TICK = 0.02  # seconds between two checks for requested images
_LONG_TICK = 0.5  # the same without browsers
_POLL = 2.0  # seconds between two checks for a newer scene
# The norm of the quaternion of a valid pose is above this value and below its inverse. Its distance
# from the origin is below the inverse.
_SMALL = 1e-9

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
    about: list[str]


@dataclass(frozen=True)
class _Browser:
    client: viser.ClientHandle
    connection: Connection
    visitor: Visitor
    controls: Controls


class NetworkViewer:
    """A page at `url` that shows Gaussians.

    Attributes:
        others: the addresses of the page for other machines, if they differ from `url`.

    In the page, the keys move the camera at a fixed speed, and distances have fixed limits. So its
    frame is the world in another unit, a power of two, in which the near plane is the usual one.

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
        self._world_from_page = replace(Similarity.identity(), scale=views[0].camera.near / NEAR)
        change = self._world_from_page.inverse()
        views = [replace(view, camera=view.camera.transformed(change)) for view in views]
        self._bounds = change.apply(dataset.bounds)
        running = start_server(host, port, label, allow_host)
        self.server, self.url, self.others = running.server, running.url, running.others
        set_theme(self.server.gui, dark=True)
        self._photos = Photos(
            self.server,
            self.session,
            views[: len(dataset.train)],
            views[len(dataset.train) :],
            change.scale * dataset.extent,
            self._bounds.mean(0),
            self.background,
        )
        self._browsers: dict[int, _Browser] = {}
        self._photos.on_click(self._clicked)
        self.server.on_client_connect(self._entered)
        self.server.on_client_disconnect(self._left)
        self._time_limit = ServerTimeLimit(self.server, lambda: self.session.training)
        running.open()

    def close(self) -> None:
        """Close the page."""
        self._photos.close()
        stop_server(self.server)

    # The following methods run in the server's thread. Events are processed in order, and the next
    # message is read only after the previous one is processed.

    async def _entered(self, client: viser.ClientHandle) -> None:
        visitor = self.session.enter(client.client_id)
        controls = Controls(client, self.session, visitor, self._photos, self._bounds)
        KeyCameras(client, visitor, self._world_from_page)
        Shortcuts(client, controls, self._bounds)
        connection = current_connection.get()
        connection.on_arrival = functools.partial(self.session.arrived, visitor)
        self._browsers[client.client_id] = _Browser(client, connection, visitor, controls)
        self._photos.begin()

        def move(pose: Pose) -> None:
            self.session.move(visitor, pose)
            controls.follow()
            if visitor.going:
                asyncio.get_running_loop().call_later(MOVE_SECONDS, move_again, pose)

        def move_again(pose: Pose) -> None:
            if visitor.going and visitor.pose is pose:
                move(pose)

        async def moved(camera: viser.CameraHandle) -> None:
            pose = _pose(camera)
            if pose is not None:
                move(pose)

        await moved(client.camera)
        client.camera.on_update(moved)

    async def _left(self, client: viser.ClientHandle) -> None:
        self.session.leave(client.client_id)
        self._browsers.pop(client.client_id, None)

    def _clicked(self, client: viser.ClientHandle, index: int) -> None:
        browser = self._browsers.get(client.client_id)
        if browser is not None:
            browser.controls.go_to_photo(index)

    def _send(self, request: RenderRequest, image: np.ndarray, drawing: float) -> None:
        started = time.monotonic()
        browser = next((b for b in self._browsers.values() if b.visitor is request.visitor), None)
        try:
            if browser is not None:  # None: the browser has disconnected
                scene, quality = browser.client.scene, _QUALITY[request.kind]
                with self._time_limit.uncounted():
                    scene.set_background_image(image, format="jpeg", jpeg_quality=quality)
                browser.connection.image_handed()
                browser.client.flush()
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
            call_in_server_thread(self.server, lambda: self._send(request, image, seconds))
        except Exception:  # an invalid request of a browser must not end the training
            _log.debug("an image was not rendered", exc_info=True)
        self.session.record_rendering(request, scene, time.monotonic() - started)
        return True

    def _draw(self, request: RenderRequest, gaussians: Gaussians) -> np.ndarray:
        width, height, display, photo = request.width, request.height, request.display, None
        if request.photo_view is None:
            camera = request.pose.camera(width, height)
        else:
            photo = fitted_photo(request.photo_view, width, height)
            camera = photo.placed.camera(request.photo_view.camera, width, height)
        if display.crop is not None:
            box = self._world_from_page.apply(torch.tensor(display.crop, dtype=torch.float64))
            (x, y, z), (u, v, w) = box.tolist()
            display = replace(display, crop=((x, y, z), (u, v, w)))
        camera = camera.transformed(self._world_from_page)
        return draw(gaussians, camera, display, self.background, photo)

    def wait(self) -> None:
        """Wait for a change, or a fraction of a second."""
        self.session.wait(_TICK if self.session.visitors else _LONG_TICK)

    def show_newest(self, newest: Callable[[], Scene]) -> None:
        """Show the scene that ``newest`` returns, until Ctrl-C, which raises KeyboardInterrupt."""
        panel = ScenePanel(self.server)
        scene, checked = None, 0.0
        while True:
            if time.monotonic() - checked > _POLL:
                before, scene = scene, newest()
                checked = time.monotonic()
                if scene != before:
                    panel.show(scene.about)
            assert scene is not None
            if scene.gaussians is None or not self.serve(
                scene.gaussians, scene.number, training=False
            ):
                self.wait()


def _pose(camera: viser.CameraHandle) -> Pose | None:
    """The pose of a browser; None if it is not valid."""
    quat, position = torch.from_numpy(camera.wxyz.copy()), torch.from_numpy(camera.position.copy())
    turned = _SMALL < float(quat.norm()) < 1.0 / _SMALL
    inside = float(position.norm()) < 1.0 / _SMALL
    if not (turned and inside) or min(camera.image_width, camera.image_height) < 1:
        return None
    if not camera.fov > 0:
        return None
    return Pose(quat, position, camera.fov, camera.image_width, camera.image_height)
