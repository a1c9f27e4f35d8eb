"""The cameras of the photos: as frustums in the scene, and as places to stand at."""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import math
import threading
import time
from collections.abc import Callable, Sequence

import torch
import viser
from PIL import Image
from torch import Tensor

from snowsplat import ops
from snowsplat.data import View
from snowsplat.data.decode import load_image
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import quat_from_rotation
from snowsplat.trajectory.focus import up_of
from snowsplat.util.errors import UserError
from snowsplat.viewer.live.guard import tell
from snowsplat.viewer.live.look import Placed, Pose, fit
from snowsplat.viewer.live.pictures import Photo
from snowsplat.viewer.live.session import Session, Stand, Visitor

#: The parent of all frustums.
FRUSTUMS = "/photos"
_TRAIN_COLOR, _TEST_COLOR = (70, 130, 230), (240, 150, 40)
# Length of a frustum, in the distance to the next camera, and in extents of the scene at most; how
# many there are at most; the longer side of the small photos in them, pixels.
_LENGTH, _LONGEST, _MOST, _SMALL = 0.6, 0.06, 400, 96
# While a training runs, the small photos are read in this part of the time.
_READING = 0.2


class Photos:
    """The photos of a dataset in the scene of a server.

    Attributes:
        views: those to train on, then those held out.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        train: Sequence[View],
        test: Sequence[View],
        extent: float,
        centre: Tensor,
        background: Tensor,
    ) -> None:
        """
        Args:
            extent: of the scene, world units.
            centre: (3,) of the scene, about which a browser turns.
            background: (3,) behind transparent photos.
        """
        self.views = [*train, *test]
        self._server, self._session = server, session
        self._extent = extent
        self._length = _LONGEST * extent
        if len(self.views) > 1:
            places = torch.stack([view.camera.position.detach() for view in self.views])
            spacing = ops.neighbours(places.to(torch.float32).contiguous(), k=1).median()
            self._length = min(max(_LENGTH * float(spacing), 0.2 * self._length), self._length)
        self._centre = centre.to(torch.float64)
        self._background = background
        self._reading = asyncio.Semaphore(1)
        self._began = threading.Event()  # reading the small photos
        self._closed = threading.Event()
        self._frustums: dict[int, viser.CameraFrustumHandle] = {}
        server.scene.add_frame(FRUSTUMS, show_axes=False)
        every = -(-len(self.views) // _MOST)
        for index, view in enumerate(self.views):
            if index % every == 0:
                color = _TRAIN_COLOR if index < len(train) else _TEST_COLOR
                self._frustums[index] = self._add_frustum(server, index, view.camera, color)
        if self.views:
            first = self.views[0].camera
            pose = self._pose(first, first.width, first.height)
            start = server.initial_camera
            start.position, start.look_at = pose.position.numpy(), self._look_at(first).numpy()
            up = up_of([view.camera for view in self.views]).numpy()
            server.scene.set_up_direction(up)
            start.up, start.fov = up, pose.fov

    def _add_frustum(
        self, server: viser.ViserServer, index: int, camera: Camera, color: tuple[int, int, int]
    ) -> viser.CameraFrustumHandle:
        pose = camera.world_from_cam.detach().to(torch.float64)
        return server.scene.add_camera_frustum(
            f"{FRUSTUMS}/{index}",
            fov=2.0 * math.atan(0.5 * camera.height / camera.fy),
            aspect=camera.width / camera.height,
            scale=self._length,
            thickness=1.5,
            thickness_units="screen",
            color=color,
            wxyz=quat_from_rotation(pose[:, :3]).numpy(),
            position=pose[:, 3].numpy(),
            cast_shadow=False,
            receive_shadow=False,
        )

    def on_click(self, stand_at: Callable[[viser.ClientHandle, int], None]) -> None:
        """Call this with the browser that clicks a frustum, and the photo's number."""

        def register(index: int, frustum: viser.CameraFrustumHandle) -> None:
            @frustum.on_click
            async def _(event: viser.SceneNodePointerEvent) -> None:
                stand_at(event.client, index)

        for index, frustum in self._frustums.items():
            register(index, frustum)

    async def read(self, visitor: Visitor, index: int) -> Stand:
        """Where a photo was taken, and the photo; one is read at a time, whoever asks.

        Raises:
            UserError: the photo is absent or damaged.
        """
        view = self.views[index]
        async with self._reading:
            started = time.monotonic()
            photo = await asyncio.to_thread(load_image, view.image, self._background.tolist())
            if self._session.training:  # which has its share of the time
                await asyncio.sleep(time.monotonic() - started)
        now = visitor.pose
        width, height = (now.width, now.height) if now else (view.camera.width, view.camera.height)
        return Stand(index, view.camera, photo, self._pose(view.camera, width, height))

    def send(self, client: viser.ClientHandle, visitor: Visitor, stand: Stand) -> None:
        """Send a browser there."""
        self._session.send(visitor, stand)
        up = -stand.camera.cam_from_world[1, :3].detach()
        with client.atomic():
            client.camera.fov = stand.pose.fov
            client.camera.position = stand.pose.position.numpy()
            client.camera.up_direction = up.numpy()
            client.camera.look_at = self._look_at(stand.camera).numpy()

    def _pose(self, camera: Camera, width: int, height: int) -> Pose:
        """Of a browser that sees the whole photo in a window of this size."""
        placed = Placed.within(camera, width, height).camera(camera, width, height)
        pose = camera.world_from_cam.detach().to(torch.float64)
        fov = 2.0 * math.atan(0.5 * height / placed.fy)
        return Pose(quat_from_rotation(pose[:, :3]), pose[:, 3], fov, width, height)

    def _look_at(self, camera: Camera) -> Tensor:
        """The point on its axis that is nearest to the centre of the scene, in front of it."""
        pose = camera.world_from_cam.detach().to(torch.float64)
        axis, position = pose[:, 2], pose[:, 3]
        distance = max(float(axis @ (self._centre - position)), 0.1 * self._extent)
        return position + distance * axis

    # Small photos, in the background

    def begin(self) -> None:
        """Read the small photos, if that has not begun."""
        if not self._began.is_set():
            self._began.set()
            threading.Thread(target=self._read, name="snowsplat-photos", daemon=True).start()

    def _read(self) -> None:
        for index, frustum in self._frustums.items():
            started = time.monotonic()
            source = self.views[index].image
            width, height = fit(source.width, source.height, _SMALL)
            small = dataclasses.replace(source, width=width, height=height)
            try:
                planes = load_image(small, self._background.tolist())
            except UserError:
                continue  # the training, or standing there, will say so
            if self._closed.is_set():
                return
            pixels = planes.permute(1, 2, 0).contiguous().numpy()
            tell(self._server, functools.partial(setattr, frustum, "image", pixels))
            rest = (1.0 / _READING - 1.0) if self._session.training else 0.0
            if self._closed.wait(rest * (time.monotonic() - started)):
                return

    def close(self) -> None:
        """Stop reading."""
        self._closed.set()


def placed_photo(stand: Stand, width: int, height: int) -> Photo:
    """The photo as it lies in a picture of this size."""
    placed = Placed.within(stand.camera, width, height)
    image = Image.fromarray(stand.photo.permute(1, 2, 0).contiguous().numpy())
    resized = image.resize((placed.width, placed.height), Image.Resampling.BILINEAR)
    pixels = torch.frombuffer(bytearray(resized.tobytes()), dtype=torch.uint8)
    return Photo(pixels.view(placed.height, placed.width, 3), placed)
