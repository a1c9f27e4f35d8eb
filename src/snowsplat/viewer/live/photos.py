"""The cameras of the photos: frustums in the scene, and views to which a browser can go."""

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
from snowsplat.viewer.live.display import PhotoRectangle, Pose, fit
from snowsplat.viewer.live.guard import call_in_server_thread
from snowsplat.viewer.live.pictures import Photo
from snowsplat.viewer.live.session import PhotoView, Session, Visitor

#: The parent of all frustums.
FRUSTUMS = "/photos"
_TRAIN_COLOR = (70, 130, 230)
_TEST_COLOR = (240, 150, 40)
_LENGTH = 0.6  # length of a frustum, relative to the distance of neighbouring cameras
_MAX_LENGTH = 0.06  # maximum length of a frustum, relative to the extent of the scene
_MAX_FRUSTUMS = 400  # maximum number of frustums
_THUMBNAIL_SIDE = 96  # pixels: longer side of the thumbnails in frustums
_READING_SHARE = 0.2  # maximum share of the time for reading thumbnails during training


class Photos:
    """The photos of a dataset in the scene of a server."""

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
            train, test: with cameras in the frame of the page, see `NetworkViewer`.
            extent, centre: of the scene in that frame; (3,), around which a browser rotates.
            background: (3,) colour behind transparent photos, 0..1.
        """
        self.views = [*train, *test]
        self._server, self._session = server, session
        self._extent = extent
        self._length = _MAX_LENGTH * extent
        if len(self.views) > 1:
            places = torch.stack([view.camera.position.detach() for view in self.views])
            spacing = ops.neighbours(places.to(torch.float32).contiguous(), k=1).median()
            self._length = min(max(_LENGTH * float(spacing), 0.2 * self._length), self._length)
        self._centre = centre.to(torch.float64)
        self._background = background
        self._reading = asyncio.Semaphore(1)
        self._began = threading.Event()  # set when reading thumbnails begins
        self._closed = threading.Event()
        self._frustums: dict[int, viser.CameraFrustumHandle] = {}
        server.scene.add_frame(FRUSTUMS, show_axes=False)
        every = -(-len(self.views) // _MAX_FRUSTUMS)
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

    def on_click(self, go_to_photo: Callable[[viser.ClientHandle, int], None]) -> None:
        """Call ``go_to_photo`` with the browser that clicked a frustum, and the photo's index."""

        def register(index: int, frustum: viser.CameraFrustumHandle) -> None:
            @frustum.on_click
            async def _(event: viser.SceneNodePointerEvent) -> None:
                go_to_photo(event.client, index)

        for index, frustum in self._frustums.items():
            register(index, frustum)

    async def read(self, visitor: Visitor, index: int) -> PhotoView:
        """Read a photo. Only one photo is read at a time, for all browsers together.

        Raises: UserError: the photo is missing or damaged.
        """
        view = self.views[index]
        async with self._reading:
            started = time.monotonic()
            photo = await asyncio.to_thread(load_image, view.image, self._background.tolist())
            if self._session.training:  # read photos during at most half of the time
                await asyncio.sleep(time.monotonic() - started)
        now = visitor.pose
        width, height = (now.width, now.height) if now else (view.camera.width, view.camera.height)
        return PhotoView(index, view.camera, photo, self._pose(view.camera, width, height))

    def go_to(self, client: viser.ClientHandle, visitor: Visitor, photo_view: PhotoView) -> None:
        """Move the browser to the pose of the photo."""
        self._session.set_photo_view(visitor, photo_view)
        up = -photo_view.camera.cam_from_world[1, :3].detach()
        with client.atomic():
            client.camera.fov = photo_view.pose.fov
            client.camera.position = photo_view.pose.position.numpy()
            client.camera.up_direction = up.numpy()
            client.camera.look_at = self._look_at(photo_view.camera).numpy()

    def _pose(self, camera: Camera, width: int, height: int) -> Pose:
        """The pose at which a browser window of this size shows the whole photo of ``camera``."""
        placed = PhotoRectangle.within(camera, width, height).camera(camera, width, height)
        pose = camera.world_from_cam.detach().to(torch.float64)
        fov = 2.0 * math.atan(0.5 * height / placed.fy)
        return Pose(quat_from_rotation(pose[:, :3]), pose[:, 3], fov, width, height)

    def _look_at(self, camera: Camera) -> Tensor:
        """The point on the optical axis, in front of the camera, nearest to the scene centre."""
        pose = camera.world_from_cam.detach().to(torch.float64)
        axis, position = pose[:, 2], pose[:, 3]
        distance = max(float(axis @ (self._centre - position)), 0.1 * self._extent)
        return position + distance * axis

    # Thumbnails, in the background

    def begin(self) -> None:
        """Start reading thumbnails in a thread, if it has not been started yet."""
        if not self._began.is_set():
            self._began.set()
            threading.Thread(target=self._read, name="snowsplat-photos", daemon=True).start()

    def _read(self) -> None:
        for index, frustum in self._frustums.items():
            started = time.monotonic()
            source = self.views[index].image
            width, height = fit(source.width, source.height, _THUMBNAIL_SIDE)
            small = dataclasses.replace(source, width=width, height=height)
            try:
                planes = load_image(small, self._background.tolist())
            except UserError:
                continue  # the error is reported by the training, or when a user goes to the photo
            if self._closed.is_set():
                return
            pixels = planes.permute(1, 2, 0).contiguous().numpy()
            call_in_server_thread(
                self._server, functools.partial(setattr, frustum, "image", pixels)
            )
            rest = (1.0 / _READING_SHARE - 1.0) if self._session.training else 0.0
            if self._closed.wait(rest * (time.monotonic() - started)):
                return

    def close(self) -> None:
        """Stop reading thumbnails."""
        self._closed.set()


def fitted_photo(photo_view: PhotoView, width: int, height: int) -> Photo:
    """The photo, resized to its rectangle in an image of this size."""
    placed = PhotoRectangle.within(photo_view.camera, width, height)
    image = Image.fromarray(photo_view.photo.permute(1, 2, 0).contiguous().numpy())
    resized = image.resize((placed.width, placed.height), Image.Resampling.BILINEAR)
    pixels = torch.frombuffer(bytearray(resized.tobytes()), dtype=torch.uint8)
    return Photo(pixels.view(placed.height, placed.width, 3), placed)
