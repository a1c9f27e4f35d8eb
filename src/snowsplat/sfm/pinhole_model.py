"""Converts the COLMAP model of the photos to a model of the undistorted images.

The new model has pinhole cameras and is in the frame of the scene (see `orient`). A photo of a wide
lens becomes several images.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from snowsplat.data.lens.pinhole import Pinhole
from snowsplat.data.lens.project import directions
from snowsplat.data.lens.views import LensView
from snowsplat.scene.geometry import Similarity

if TYPE_CHECKING:
    import pycolmap


def write_model(
    model: pycolmap.Reconstruction,
    pinholes: Mapping[int, Pinhole],
    scene_from_sfm: Similarity,
    sparse: Path,
) -> None:
    """Transform ``model`` in place and write it to ``sparse``/0; replaces an existing folder.

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
    # Write to a folder with a temporary name, so that ``sparse`` never contains a part of a model.
    new = sparse.with_name(f".{sparse.name}.new")
    shutil.rmtree(new, ignore_errors=True)
    (new / "0").mkdir(parents=True)
    model.write(new / "0")
    model.export_PLY(new / "0" / "points3D.ply")
    shutil.rmtree(sparse, ignore_errors=True)
    new.rename(sparse)


def view_name(photo: str, view: LensView) -> str:
    """The name of the image that shows a view of ``photo``."""
    path = PurePosixPath(photo)
    return str(path.with_name(f"{path.stem}_{view.name}{path.suffix}")) if view.name else photo


def in_views(
    model: pycolmap.Reconstruction, views: Mapping[int, Sequence[LensView]]
) -> pycolmap.Reconstruction:
    """A model in which each photo of a wide lens is replaced by its pinhole views.

    Args:
        model: with lens distortion; it is not changed.
        views: those of the photos of each wide camera, by camera id.

    A point has an observation in each view that shows its feature. The other cameras and their ids
    remain.
    """
    import pycolmap

    made, next_camera = pycolmap.Reconstruction(), max(model.cameras) + 1
    cameras: dict[tuple[int, str], int] = {}
    for number, camera in model.cameras.items():
        if number not in views:
            made.add_camera_with_trivial_rig(pycolmap.Camera(camera.todict()))
        for view in views.get(number, ()):
            size = {"width": view.width, "height": view.height, "params": list(view.params)}
            made.add_camera_with_trivial_rig(
                pycolmap.Camera(camera_id=next_camera, model="PINHOLE", **size)
            )
            cameras[number, view.name] = next_camera
            next_camera += 1
    tracks: dict[int, list[pycolmap.TrackElement]] = {}
    next_image = 1

    def add(name: str, camera: int, pose: pycolmap.Rigid3d, xy: np.ndarray, ids: list[int]) -> None:
        """An image with the features ``xy`` (N, 2) of the points ``ids``."""
        nonlocal next_image
        image = pycolmap.Image(name, xy, camera, next_image)
        made.add_image_with_trivial_frame(image, pose)
        for row, point in enumerate(ids):
            tracks.setdefault(point, []).append(pycolmap.TrackElement(next_image, row))
        next_image += 1

    for number in sorted(model.reg_image_ids()):
        image = model.image(number)
        pose = image.cam_from_world()
        observed = [point for point in image.points2D if point.has_point3D()]
        xy = np.array([point.xy for point in observed]).reshape(-1, 2)
        ids = [int(point.point3D_id) for point in observed]
        if image.camera_id not in views:
            add(image.name, image.camera_id, pose, xy, ids)
            continue
        rays = directions(views[image.camera_id][0].lens, xy)
        for view in views[image.camera_id]:
            rotation = np.eye(3) if view.rotation is None else np.array(view.rotation)
            turned = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.zeros(3))
            x, y, z = rotation @ rays.T
            fx, fy, cx, cy = view.params
            with np.errstate(all="ignore"):
                pixels = np.stack([fx * x / z + cx, fy * y / z + cy], 1)
            seen = (z > 0) & ((pixels >= 0) & (pixels <= [view.width, view.height])).all(1)
            (rows,) = np.nonzero(seen)
            name, camera_id = view_name(image.name, view), cameras[image.camera_id, view.name]
            add(name, camera_id, turned * pose, pixels[rows], [ids[row] for row in rows])
    for point, track in tracks.items():
        old = model.points3D[point]
        made.add_point3D(old.xyz, pycolmap.Track(track), old.color)
    made.update_point_3d_errors()
    return made


def _undistort_keypoints(image: pycolmap.Image, camera: pycolmap.Camera, pinhole: Pinhole) -> None:
    points = image.points2D
    if not len(points):
        return
    fx, fy, cx, cy = pinhole.params
    pixels = camera.cam_from_img(np.array([point.xy for point in points])) * (fx, fy) + (cx, cy)
    for point, xy in zip(points, pixels, strict=True):
        # Near the border, the lens model may have no inverse. Programs that read the model need
        # finite numbers.
        point.xy = xy if np.isfinite(xy).all() else np.array([-1.0, -1.0])
