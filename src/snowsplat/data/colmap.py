"""A folder with a COLMAP model and images -> posed images and points.

COLMAP's conventions are ours (`Camera`): OpenCV axes, cam_from_world, pixel centres at one half. So
nothing is converted here.
"""

from __future__ import annotations

import logging
import math
from pathlib import Path

import torch

from snowsplat.data.colmap_files import (
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    count_images,
    make_points,
    model_is_text,
    read_model,
    read_points,
)
from snowsplat.data.dataset import Points, PosedImage, safe_name
from snowsplat.data.points_ply import read_points as read_points_ply
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import inside, is_file, quoted

logger = logging.getLogger(__name__)

# The camera models that are a pinhole camera when all parameters after the principal point are 0,
# and whether they have one focal length (f, cx, cy) or two (fx, fy, cx, cy).
_FOCAL_LENGTHS = {
    "SIMPLE_PINHOLE": 1,
    "PINHOLE": 2,
    "SIMPLE_RADIAL": 1,
    "RADIAL": 1,
    "OPENCV": 2,
    "FULL_OPENCV": 2,
}


def find_models(parent: Path) -> list[Path]:
    """``parent`` and the folders in it that hold a COLMAP model, the one with most images first."""
    if not parent.is_dir():
        return []
    folders = [*sorted(p for p in parent.iterdir() if p.is_dir()), parent]
    models = [folder for folder in folders if model_is_text(folder) is not None]
    return sorted(models, key=lambda folder: -count_images(folder))  # stable: the first of equals


def read_colmap(
    root: Path, models: list[Path], images: str
) -> tuple[list[PosedImage], Points | None, str]:
    """Posed images that are on disk, points, and a description, from the first of ``models``.

    Raises:
        UserError: damaged files, distorted cameras, no images.
    """
    folder = models[0]
    shown = folder.relative_to(root).as_posix()
    if len(models) > 1:
        others = ", ".join(
            f"{m.relative_to(root).as_posix()} ({count_images(m)})" for m in models[1:]
        )
        logger.warning(
            "%s: COLMAP made %d separate models; taking the largest, %s (%d images), not %s",
            root,
            len(models),
            shown,
            count_images(folder),
            others,
        )
    model = read_model(folder)
    if not model.images:
        raise UserError(f"{folder}: the COLMAP model has no images; run COLMAP again")
    image_folder = root / images
    if not image_folder.is_dir():
        there = sorted(p.name for p in root.iterdir() if p.is_dir())
        raise UserError(
            f"{image_folder}: no such folder of images; name the right one with --images"
            + (f" (there are: {', '.join(there)})" if there else "")
        )
    posed, missing = [], []
    for image in model.images:
        if inside(image_folder, image.name) is None:
            raise UserError(
                f"{folder}: names the image {quoted(image.name)}, which is not in {image_folder}; "
                "run COLMAP again, with the images in one folder"
            )
        if not is_file(image_folder / image.name):
            missing.append(image.name)
            continue
        posed.append(
            PosedImage(
                safe_name(image.name),
                posed_camera(model, image),
                image_folder,
                image.name,
                _find_mask(root / "masks", image.name),
            )
        )
    if not posed:
        raise UserError(
            f"{image_folder}: none of the {len(missing)} images of the model is here (the first is "
            f"{quoted(missing[0])}); name the right folder with --images"
        )
    if missing:
        logger.warning(
            "%s: %d of %d images are missing (the first is %r); skipped",
            image_folder,
            len(missing),
            len(model.images),
            missing[0][:80],
        )
    points = read_points(folder)
    ply = folder / "points3D.ply"
    if points is None and ply.is_file():
        points = make_points(ply, *read_points_ply(ply))
    if points is None:
        logger.warning("%s: the model has no points; training starts from random ones", folder)
    return posed, points, f"COLMAP model {shown} ({'text' if model.text else 'binary'})"


def posed_camera(model: ColmapModel, image: ColmapImage) -> Camera:
    """The camera of an image.

    Raises:
        UserError: a camera that is missing, distorted, or makes no sense.
    """
    colmap = model.cameras.get(image.camera_id)
    if colmap is None:
        raise UserError(
            f"{model.folder}: image {image.name[:80]} has camera {image.camera_id}, which the "
            "model does not hold; copy the model again"
        )
    fx, fy, cx, cy = _pinhole(model.folder, colmap)
    quat, translation = torch.tensor(image.pose, dtype=torch.float64).split([4, 3])
    if not (0.5 < float(quat.norm()) < 2.0 and float(translation.abs().max()) < 1e15):
        raise UserError(
            f"{model.folder}: the pose of image {image.name[:80]} is damaged; copy it again"
        )
    pose = torch.cat([rotation_from_quat(quat), translation[:, None]], 1)
    return Camera(colmap.width, colmap.height, fx, fy, cx, cy, pose)


def _pinhole(folder: Path, camera: ColmapCamera) -> tuple[float, float, float, float]:
    focal_lengths = _FOCAL_LENGTHS.get(camera.model)
    if focal_lengths is None or any(camera.params[focal_lengths + 2 :]):
        raise UserError(
            f"{folder}: its cameras have lens distortion (model {camera.model[:40]}), and "
            "Gaussians are drawn without; undistort the images first: put them into NEW/input and "
            "the model into NEW/distorted/sparse/0, run snowsplat sfm -s NEW --skip-matching, "
            "then use NEW"
        )
    f, (cx, cy) = camera.params[:focal_lengths], camera.params[focal_lengths : focal_lengths + 2]
    if not all(map(math.isfinite, (*f, cx, cy))) or min(f) <= 0 or max(*f, abs(cx), abs(cy)) > 1e9:
        raise UserError(f"{folder}: the intrinsics of a camera are damaged; copy the model again")
    return f[0], f[-1], cx, cy


def _find_mask(folder: Path, name: str) -> Path | None:
    """``masks/IMG.jpg.png``, as COLMAP names the mask of ``IMG.jpg``, or ``masks/IMG.png``."""
    for candidate in (f"{name}.png", str(Path(name).with_suffix(".png"))):
        if is_file(folder / candidate):
            return folder / candidate
    return None
