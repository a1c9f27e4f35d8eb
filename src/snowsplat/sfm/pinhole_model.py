"""Converts the COLMAP model of the photos to a model of the undistorted images.

The new model has pinhole cameras and is in the frame of the scene (see `orient`). A photo of a wide
lens, and a panorama, becomes several images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from snowsplat.data.lens.views import LensView
from snowsplat.scene.geometry import Similarity

if TYPE_CHECKING:
    import pycolmap


def write_model(
    model: pycolmap.Reconstruction,
    pinholes: Mapping[int, LensView],
    scene_from_sfm: Similarity,
    sparse: Path,
) -> None:
    """Transform ``model`` in place and write it to ``sparse``/0, a new folder.

    Points keep their tracks and colours. Keypoints are moved to their undistorted positions.
    ``pinholes`` maps camera ids to the new cameras; the others are pinhole cameras already.
    """
    import pycolmap

    scale, rotation = scene_from_sfm.scale, scene_from_sfm.rotation.numpy()
    shift = scene_from_sfm.translation.numpy()[:, None]
    model.transform(pycolmap.Sim3d(np.concatenate([scale * rotation, shift], axis=1)))
    for image in model.images.values():
        if image.camera_id in pinholes:
            _undistort_keypoints(image, model.cameras[image.camera_id], pinholes[image.camera_id])
    for number, pinhole in pinholes.items():
        camera = model.cameras[number]
        camera.model = pycolmap.CameraModelId.PINHOLE
        camera.width, camera.height = pinhole.width, pinhole.height
        camera.params = list(pinhole.params)
    folder = sparse / "0"
    folder.mkdir(parents=True)
    model.write(folder)
    model.export_PLY(folder / "points3D.ply")


def view_name(photo: str, view: LensView) -> str:
    """The name of the image that shows a view of ``photo``."""
    path = PurePosixPath(photo)
    return str(path.with_name(f"{path.stem}_{view.name}{path.suffix}")) if view.name else photo


def photo_of(view: str) -> str:
    """The name of the photo that the image ``view`` shows a part of; the inverse of `view_name`."""
    path = PurePosixPath(view)
    return str(path.with_name(path.stem.rpartition("_")[0] + path.suffix))


def in_views(
    model: pycolmap.Reconstruction, views: Mapping[int, Sequence[LensView]]
) -> pycolmap.Reconstruction:
    """A model in which each photo of a wide lens is replaced by its pinhole views, in a rig.

    A rig has one sensor for each view. Their centres are the same, and their rotations are known. A
    frame of the rig is one photo.

    Args:
        model: with lens distortion; it is not changed.
        views: those of the photos of each wide camera, by camera id.

    A point has an observation in each view that shows its feature. The other cameras and their ids
    remain.
    """
    import pycolmap

    made, next_camera = pycolmap.Reconstruction(), max(model.cameras) + 1
    cameras: dict[int, list[pycolmap.Camera]] = {}  # those of the views of each wide camera
    for number, camera in model.cameras.items():
        if number not in views:
            made.add_camera_with_trivial_rig(pycolmap.Camera(camera.todict()))
            continue
        cameras[number] = []
        for view in views[number]:
            size = {"width": view.width, "height": view.height, "params": list(view.params)}
            cameras[number].append(pycolmap.Camera(camera_id=next_camera, model="PINHOLE", **size))
            made.add_camera(cameras[number][-1])
            next_camera += 1
        made.add_rig(_rig(number, cameras[number], views[number]))
    tracks: dict[int, list[pycolmap.TrackElement]] = {}
    next_image = 1

    def image_of(
        name: str, camera: int, frame: int, xy: np.ndarray, ids: list[int]
    ) -> pycolmap.Image:
        """An image with the features ``xy`` (N, 2) of the points ``ids``."""
        nonlocal next_image
        image = pycolmap.Image(name, xy, camera, next_image)
        image.frame_id = frame
        for row, point in enumerate(ids):
            tracks.setdefault(point, []).append(pycolmap.TrackElement(next_image, row))
        next_image += 1
        return image

    for number in sorted(model.reg_image_ids()):
        image = model.image(number)
        pose, camera_id = image.cam_from_world(), image.camera_id
        observed = [point for point in image.points2D if point.has_point3D()]
        xy = np.array([point.xy for point in observed]).reshape(-1, 2)
        ids = [int(point.point3D_id) for point in observed]
        if camera_id not in views:
            images = [image_of(image.name, camera_id, number, xy, ids)]
        else:
            images, first = [], _rotation(views[camera_id][0])
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(first), np.zeros(3)) * pose
            rays = views[camera_id][0].lens.directions(xy)
            for view, camera in zip(views[camera_id], cameras[camera_id], strict=True):
                pixels, rows = _pixels_in_view(view, rays)
                points = [ids[row] for row in rows]
                name = view_name(image.name, view)
                images.append(image_of(name, camera.camera_id, number, pixels[rows], points))
        frame = pycolmap.Frame()
        frame.frame_id, frame.rig_id, frame.rig_from_world = number, camera_id, pose
        for part in images:
            frame.add_data_id(part.data_id)
        made.add_frame(frame)
        for part in images:
            made.add_image(part)
        made.register_frame(number)
    for point, track in tracks.items():
        old = model.points3D[point]
        made.add_point3D(old.xyz, pycolmap.Track(track), old.color)
    made.update_point_3d_errors()
    return made


def _rig(
    number: int, cameras: Sequence[pycolmap.Camera], views: Sequence[LensView]
) -> pycolmap.Rig:
    """The rig of the ``cameras`` of ``views``; the frame of the first one is that of the rig."""
    import pycolmap

    rig = pycolmap.Rig()
    rig.rig_id = number
    rig.add_ref_sensor(cameras[0].sensor_id)
    first = _rotation(views[0])
    for camera, view in zip(cameras[1:], views[1:], strict=True):
        turned = pycolmap.Rotation3d(_rotation(view) @ first.T)
        rig.add_sensor(camera.sensor_id, pycolmap.Rigid3d(turned, np.zeros(3)))
    return rig


def _rotation(view: LensView) -> np.ndarray:
    """(3, 3) view_from_lens."""
    return np.eye(3) if view.rotation is None else np.array(view.rotation)


def _pixels_in_view(view: LensView, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pixels (N, 2) of directions (N, 3) of a lens in a view, and the rows that it shows."""
    x, y, z = _rotation(view) @ rays.T
    fx, fy, cx, cy = view.params
    with np.errstate(all="ignore"):
        pixels = np.stack([fx * x / z + cx, fy * y / z + cy], 1)
    seen = (z > 0) & ((pixels >= 0) & (pixels <= [view.width, view.height])).all(1)
    return pixels, np.flatnonzero(seen)


def _undistort_keypoints(image: pycolmap.Image, camera: pycolmap.Camera, pinhole: LensView) -> None:
    points = image.points2D
    if not len(points):
        return
    fx, fy, cx, cy = pinhole.params
    pixels = camera.cam_from_img(np.array([point.xy for point in points])) * (fx, fy) + (cx, cy)
    for point, xy in zip(points, pixels, strict=True):
        # Near the border, the lens model may have no inverse. Programs that read the model need
        # finite numbers.
        point.xy = xy if np.isfinite(xy).all() else np.array([-1.0, -1.0])
