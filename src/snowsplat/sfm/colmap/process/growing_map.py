"""The photos that have a pose so far, and some of the points: for a map that grows.

The child process, in which COLMAP runs, makes a message of a model; the parent reads it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from snowsplat.sfm.report.scene_map import PlacedPhoto

if TYPE_CHECKING:
    import pycolmap

_MAX_POINTS = 1000
_PAUSE = 2.0  # seconds between two messages
# The pause is at least this multiple of the time that a message takes: with very many photos, the
# messages take less than 0.5% of the time.
_SHARE = 200.0


class PoseMessages:
    """Makes messages of a model that grows, at most one in two seconds."""

    def __init__(self, send: Callable[[dict[str, Any]], None]) -> None:
        """``send`` is called with each message, a JSON value; see `read_poses`."""
        self._send = send
        self._next = 0.0

    def __call__(self, model: pycolmap.Reconstruction, now: bool) -> None:
        """Send the poses and points of ``model``; unless ``now``, only if it is time for it."""
        began = time.monotonic()
        if not now and began < self._next:
            return
        self._send(_message(model))
        end = time.monotonic()
        self._next = end + max(_PAUSE, _SHARE * (end - began))


def _message(model: pycolmap.Reconstruction) -> dict[str, Any]:
    photos = []
    for number in model.reg_image_ids():
        image = model.image(number)
        camera = model.cameras[image.camera_id]
        pose = image.cam_from_world().matrix()
        # A panorama has no focal length.
        focal = camera.mean_focal_length() if camera.focal_length_idxs() else float(camera.width)
        half = camera.width / 2 / focal, camera.height / 2 / focal
        photos.append([image.name, [float(f"{value:.5g}") for value in (*pose.flat, *half)]])
    # A point that is shown remains while the number of points is about the same: the map is calm.
    ids = model.point3D_ids()
    step = 1
    while len(ids) > step * _MAX_POINTS:
        step *= 2
    points = [model.point3D(number).xyz for number in ids if number % step == 0]
    return {
        "photos": photos,
        "points": [float(f"{value:.4g}") for value in np.asarray(points).flat],
    }


def read_poses(message: dict[str, Any]) -> tuple[list[PlacedPhoto], np.ndarray]:
    """The photos of a message, and its points (P, 3). The frame is that of COLMAP: its scale and
    its orientation are arbitrary."""
    photos = []
    for name, values in message["photos"]:
        pose = np.array(values[:12]).reshape(3, 4)
        photos.append(PlacedPhoto(name, None, pose, *values[12:]))
    points = np.array(message["points"]).reshape(-1, 3)
    return photos, points[np.isfinite(points).all(axis=1)]
