"""Replaces the panoramas of a COLMAP model by pinhole views in a rig.

A rig has one sensor for each view of a panorama. Their rotations are known and their centres are
the same. A frame of the rig is one panorama.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from snowsplat.data.lens.views import LensView

if TYPE_CHECKING:
    import pycolmap

    _Element = tuple[int, int]  # image id and index of the feature


_FOLDER = "panorama_"  # the beginning of the name of the folder of a sensor


def view_name(panorama: str, view: LensView) -> str:
    """The name of a view's image. Each sensor of the rig has a folder, as COLMAP recommends."""
    return str(PurePosixPath(f"{_FOLDER}{view.name}") / panorama)


def panorama_of(name: str) -> str | None:
    """The name of the panorama of which ``name`` is a view; None: it is no view of one."""
    folder, _, panorama = name.partition("/")
    return panorama if folder.startswith(_FOLDER) and panorama else None


def with_views(
    model: pycolmap.Reconstruction, views: Mapping[int, Sequence[LensView]]
) -> pycolmap.Reconstruction:
    """A copy of ``model`` with views in place of panoramas, and the same points.

    A feature of a panorama is a feature of the view whose axis is nearest. Photos without a pose
    are left out.

    Args:
        views: of the panoramas of each camera, by its id; the first one looks ahead. The other
            cameras are copied.
    """
    import pycolmap

    made = pycolmap.Reconstruction()
    sensors: dict[int, list[int]] = {}  # camera id -> ids of the cameras of its views
    following = max(model.cameras) + 1
    for number, camera in model.cameras.items():
        if number not in views:
            made.add_camera_with_trivial_rig(camera)
            continue
        sensors[number] = list(range(following, following + len(views[number])))
        following += len(views[number])
        rig = pycolmap.Rig()
        rig.rig_id = number
        for sensor, view in zip(sensors[number], views[number], strict=True):
            pinhole = pycolmap.Camera(
                camera_id=sensor,
                model="PINHOLE",
                width=view.width,
                height=view.height,
                params=list(view.params),
            )
            made.add_camera(pinhole)
            if sensor == sensors[number][0]:
                rig.add_ref_sensor(pinhole.sensor_id)
            else:
                rotation = pycolmap.Rotation3d(np.array(view.rotation))
                rig.add_sensor(pinhole.sensor_id, pycolmap.Rigid3d(rotation, np.zeros(3)))
        made.add_rig(rig)
    elements: dict[_Element, _Element] = {}  # of the model -> of the copy
    image_id = 0
    for old in sorted(model.reg_image_ids(), key=lambda i: model.image(i).name):
        image = model.image(old)
        number = image.camera_id
        chosen, positions = _distributed(image, model.cameras[number], views.get(number, ()))
        frame = pycolmap.Frame()
        frame.frame_id, frame.rig_id = old, number
        frame.rig_from_world = image.cam_from_world()
        images = []
        for k, sensor in enumerate(sensors.get(number, [number])):
            image_id += 1
            rows = np.flatnonzero(chosen == k)
            name = view_name(image.name, views[number][k]) if number in views else image.name
            part = pycolmap.Image(name=name, camera_id=sensor, image_id=image_id)
            part.frame_id = old
            part.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in positions[rows]])
            elements |= {(old, int(row)): (image_id, i) for i, row in enumerate(rows)}
            frame.add_data_id(part.data_id)
            images.append(part)
        made.add_frame(frame)
        for part in images:
            made.add_image(part)
        made.register_frame(old)
    for point in model.points3D.values():
        track = pycolmap.Track()
        for element in point.track.elements:
            track.add_element(*elements[element.image_id, element.point2D_idx])
        made.add_point3D(point.xyz, track, point.color)
    made.update_point_3d_errors()
    return made


def _distributed(
    image: pycolmap.Image, camera: pycolmap.Camera, views: Sequence[LensView]
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) the index of the view of each feature of an image, and (N, 2) its pixel there.

    Without ``views``, the image is not divided.
    """
    pixels = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
    if not views or not len(pixels):
        return np.zeros(len(pixels), np.int64), pixels
    rays = np.asarray(camera.cam_ray_from_img(pixels))
    rotations = np.array([view.rotation for view in views])  # (V, 3, 3)
    chosen = (rays @ rotations[:, 2].T).argmax(1)
    seen = np.einsum("nij,nj->ni", rotations[chosen], rays)
    params = np.array([view.params for view in views])[chosen]
    return chosen, seen[:, :2] / seen[:, 2:] * params[:, :2] + params[:, 2:]
