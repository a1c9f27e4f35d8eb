"""The photos of a dataset: their cameras for the page, their pixels for comparisons."""

import asyncio
import dataclasses
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from snowsplat import ops
from snowsplat.data import View
from snowsplat.data.photos.decode import load_image
from snowsplat.scene.geometry import quat_from_rotation
from snowsplat.util.errors import UserError
from snowsplat.util.image_size import scaled_size
from snowsplat.viewer.live.pictures import Photo, PhotoRectangle
from snowsplat.viewer.live.session import PhotoView, Session

_LENGTH = 0.6  # length of a frustum, relative to the distance of neighbouring cameras
_MAX_LENGTH = 0.06  # maximum length of a frustum, relative to the extent of the scene
_MAX_FRUSTUMS = 400  # maximum number of frustums
_THUMBNAIL_SIDE = 96  # pixels: longer side of the thumbnails in frustums
_PHOTO_SIDE = 2560  # pixels: longer side of a photo that is compared; images are not larger
_READING_SHARE = 0.2  # maximum share of the time for reading thumbnails during training


class Photos:
    """The photos of a dataset.

    Attributes:
        views: first those of the training, then those held out.
        thumbnails: index and JPEG of the thumbnails that were read so far.
    """

    def __init__(
        self,
        session: Session,
        train: Sequence[View],
        test: Sequence[View],
        extent: float,
        background: Tensor,
    ) -> None:
        """``extent``: of the scene. ``background``: (3,) behind transparent photos, 0..1."""
        self.views = [*train, *test]
        self.thumbnails: list[tuple[int, bytes]] = []
        self._held_out = len(train)
        self._session = session
        self._length = _MAX_LENGTH * extent
        if len(self.views) > 1:
            places = torch.stack([view.camera.position.detach() for view in self.views])
            spacing = ops.neighbours(places.to(torch.float32).contiguous(), k=1).median()
            self._length = min(max(_LENGTH * float(spacing), 0.2 * self._length), self._length)
        self._background = background
        self._reading = asyncio.Semaphore(1)
        self._began = threading.Event()  # set when reading thumbnails begins
        self._closed = threading.Event()

    def description(self) -> dict[str, Any]:
        """What the page has to know: the cameras, and which of them have a frustum.

        A camera has the tangents of half of its fields of view, across and down, the quaternion
        wxyz of world_from_cam, and its centre. One of ``every`` photos has a frustum, of the
        ``length`` in world units.
        """
        photos = []
        for index, view in enumerate(self.views):
            camera = view.camera
            pose = camera.world_from_cam.detach().to(torch.float64)
            photos.append(
                {
                    "name": view.name,
                    "heldOut": index >= self._held_out,
                    "half": [0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy],
                    "quat": quat_from_rotation(pose[:, :3]).tolist(),
                    "position": pose[:, 3].tolist(),
                }
            )
        every = -(-len(self.views) // _MAX_FRUSTUMS)
        return {"photos": photos, "every": max(1, every), "length": self._length}

    async def read(self, index: int) -> PhotoView:
        """Read a photo. Only one photo is read at a time, for all browsers together.

        Raises: UserError: the photo is missing or damaged.
        """
        view = self.views[index]
        async with self._reading:
            started = time.monotonic()
            photo = await asyncio.to_thread(self._load, view, _PHOTO_SIDE)
            if self._session.training:  # read photos during at most half of the time
                await asyncio.sleep(time.monotonic() - started)
        return PhotoView(index, view.camera, photo)

    def _load(self, view: View, longest: int) -> np.ndarray:
        """(h, w, 3) uint8: the photo, not larger than this. Raises: UserError."""
        width, height = scaled_size(view.image.width, view.image.height, longest)
        small = dataclasses.replace(view.image, width=width, height=height)
        planes = load_image(small, self._background.tolist())
        return planes.permute(1, 2, 0).contiguous().numpy()

    # Thumbnails, in the background

    def begin(self, changed: Callable[[], None]) -> None:
        """Start reading thumbnails in a thread, once; it calls ``changed`` after each."""
        if not self._began.is_set():
            self._began.set()
            name = "snowsplat-photos"
            threading.Thread(target=self._read, args=(changed,), name=name, daemon=True).start()

    def _read(self, changed: Callable[[], None]) -> None:
        for index in range(0, len(self.views), max(1, -(-len(self.views) // _MAX_FRUSTUMS))):
            started = time.monotonic()
            try:
                pixels = self._load(self.views[index], _THUMBNAIL_SIDE)
            except UserError:
                continue  # the error is reported by the training, or when a user goes to the photo
            if self._closed.is_set():
                return
            self.thumbnails.append((index, jpeg(pixels, 75)))
            changed()
            rest = (1.0 / _READING_SHARE - 1.0) if self._session.training else 0.0
            if self._closed.wait(rest * (time.monotonic() - started)):
                return

    def close(self) -> None:
        """Stop reading thumbnails."""
        self._closed.set()


def fitted_photo(photo_view: PhotoView, width: int, height: int) -> Photo:
    """The photo, resized to its rectangle in an image of this size."""
    placed = PhotoRectangle.within(photo_view.camera, width, height)
    image = Image.fromarray(photo_view.photo)
    resized = image.resize((placed.width, placed.height), Image.Resampling.BILINEAR)
    pixels = torch.frombuffer(bytearray(resized.tobytes()), dtype=torch.uint8)
    return Photo(pixels.view(placed.height, placed.width, 3), placed)


def jpeg(image: np.ndarray, quality: int) -> bytes:
    """An image (H, W, 3) uint8, RGB, as JPEG."""
    encoded = cv2.imencode(
        ".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )[1]
    return encoded.tobytes()
