"""The COLMAP reader: a folder with a COLMAP model and images -> posed images and points.

COLMAP's conventions are those of `Camera`: OpenCV axes, cam_from_world, pixel centres at one half.
No conversion is needed.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import torch

from snowsplat.data.colmap.model import count_images, read_model
from snowsplat.data.colmap.places import workspace_of
from snowsplat.data.colmap.tracks import points_with_tracks
from snowsplat.data.colmap.types import ColmapImage, ColmapModel
from snowsplat.data.dataset import Points, PosedImage, safe_name, usable_points
from snowsplat.data.files.photo_files import find_photos, photos_below, warn_of_missing
from snowsplat.data.points_ply import read_points as read_points_ply
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.safe_json import inside, is_file, quoted

logger = logging.getLogger(__name__)

# A quaternion whose squared norm differs from 1 by less than this was a unit quaternion.
_ROUNDED = 1e-5


def read_colmap(
    root: Path, models: list[Path], images: str
) -> tuple[list[PosedImage], Points | None, str]:
    """Read the first of ``models``: posed images that are on disk, points, and a description.

    Args:
        root: the folder of the dataset.
        models: folders of models inside ``root``, from `find_models`.
        images: name of the folder of images inside ``root``.

    Raises: UserError: damaged files, or no images.
    """
    folder = models[0]
    name = folder.relative_to(root).as_posix()
    if len(models) > 1:
        _warn_of_other_models(root, models)
    model = read_model(folder)
    if not model.images:
        raise UserError("{folder}: the COLMAP model has no images; run COLMAP again", folder=folder)
    posed, names = _images_on_disk(workspace_of(folder, root, images), images, model)
    points = points_with_tracks(model, names)
    ply = folder / "points3D.ply"
    if points is None and ply.is_file():
        points = usable_points(ply, *read_points_ply(ply))
    if points is None:
        logger.warning("%s: the model has no points; training starts from random ones", folder)
    return posed, points, f"COLMAP model {name} ({'text' if model.text else 'binary'})"


def _warn_of_other_models(root: Path, models: Sequence[Path]) -> None:
    largest, *others = [(m.relative_to(root).as_posix(), count_images(m)) for m in models]
    logger.warning(
        "%s: COLMAP made %d separate models; using the largest, %s (%d images), not %s",
        root,
        len(models),
        *largest,
        ", ".join(f"{name} ({count})" for name, count in others),
    )


def _images_on_disk(
    root: Path, images: str, model: ColmapModel
) -> tuple[list[PosedImage], dict[int, str]]:
    """The images of a model whose files exist, and their names by image id; warns of those that
    are missing.

    They are in the folder ``root / images``. If they are not, they may be elsewhere in ``root``.
    """
    folder = root / images
    exact = [
        image.name
        for image in model.images
        if inside(folder, image.name) is not None and is_file(folder / image.name)
    ]
    places = {name: (folder, name, name) for name in exact}  # folder, file in it, name of the view
    for place in (folder, *([root] if not exact and images == "images" else [])):
        left = [image.name for image in model.images if image.name not in places]
        if not left or not place.is_dir():
            continue
        found = find_photos(model.folder, place, left, places.keys())
        for name, file in found.items():
            first = "" if place == folder else file.rpartition("/")[0].partition("/")[0]
            places[name] = (place / first, file.removeprefix(f"{first}/"), file)
    if not places:
        raise _no_images(root, images, model)
    posed, missing, names = [], [], {}
    for image in model.images:
        if image.name not in places:
            missing.append(image.name)
            continue
        where, file, name = places[image.name]
        camera, lens = posed_camera(model, image), model.cameras[image.camera_id]
        frame = model.frames.get(image.number)
        names[image.number] = safe_name(name)
        posed.append(
            PosedImage(
                safe_name(name),
                camera,
                where,
                file,
                frame=None if frame is None else str(frame),
                lens=None if lens.is_pinhole else lens,
            )
        )
    warn_of_missing(folder, missing, len(model.images))
    return posed, names


def _no_images(root: Path, images: str, model: ColmapModel) -> UserError:
    folder, first = root / images, quoted(model.images[0].name)
    if not folder.is_dir():
        found = sorted(p.name for p in root.iterdir() if p.is_dir())
        existing = f" (existing folders: {', '.join(found)})" if found else ""
        return SettingError(
            "images",
            "no such folder: {folder}; use the right one{existing}",
            folder=folder,
            existing=existing,
        )
    names = photos_below(folder)
    instead = f"; it has {len(names)} others, e.g. {quoted(names[0])}" if names else ""
    return SettingError(
        "images",
        "{folder} has none of the {images} images of the model (the first is {first}){instead}; "
        "use the right folder",
        folder=folder,
        images=len(model.images),
        first=first,
        instead=instead,
    )


def posed_camera(model: ColmapModel, image: ColmapImage) -> Camera:
    """The camera of an image, with its pose in float64. A distortion of its lens is left out.

    Raises: UserError: the camera is missing or damaged.
    """
    colmap = model.cameras.get(image.camera_id)
    if colmap is None:
        raise UserError(
            "{folder}: image {name} has camera {camera_id}, which the model does not contain; "
            "copy the model again",
            folder=model.folder,
            name=image.name[:80],
            camera_id=image.camera_id,
        )
    fx, fy, cx, cy = colmap.intrinsics
    numbers = (fx, fy, cx, cy, *colmap.params)
    if min(fx, fy) <= 0 or not all(abs(number) < 1e9 for number in numbers):
        raise UserError(
            "{folder}: the intrinsics of a camera are damaged ({model} {str}); copy the model "
            "again",
            folder=model.folder,
            model=colmap.model,
            str=" ".join(map(str, colmap.params)),
        )
    quat, translation = torch.tensor(image.pose, dtype=torch.float64).split([4, 3])
    if not (0.5 < float(quat.norm()) < 2.0 and float(translation.abs().max()) < 1e15):
        raise UserError(
            "{folder}: the pose of image {name} is damaged; copy the model again",
            folder=model.folder,
            name=image.name[:80],
        )
    rotation = rotation_from_quat(quat)
    # COLMAP and its scripts compute R and t = −R C from a quaternion as it is, without dividing by
    # its norm. If C is far from 0, this R restores C even if the quaternion is rounded.
    norm2 = quat.square().sum()
    if abs(float(norm2) - 1.0) < _ROUNDED:
        identity = torch.eye(3, dtype=torch.float64)
        rotation = identity + norm2 * (rotation - identity)
    pose = torch.cat([rotation, translation[:, None]], 1)
    return Camera(colmap.width, colmap.height, fx, fy, cx, cy, pose)
