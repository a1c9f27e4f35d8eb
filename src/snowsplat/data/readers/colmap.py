"""The COLMAP reader: a folder with a COLMAP model and images -> posed images and points.

COLMAP's conventions are those of `Camera`: OpenCV axes, cam_from_world, pixel centres at one half.
No conversion is needed.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from snowsplat.data.colmap.model import (
    count_images,
    posed_camera,
    read_model,
    read_observations,
    read_point_file,
)
from snowsplat.data.colmap.places import find_models, find_models_below, workspace_of
from snowsplat.data.colmap.types import ColmapModel, PointFile
from snowsplat.data.dataset import Points, PosedImage, Tracks, safe_name, usable_points
from snowsplat.data.files.photo_files import (
    find_photos,
    photos_below,
    warn_of_missing,
    warn_of_unusable,
)
from snowsplat.data.frame.placement import read_placement
from snowsplat.data.readers import transforms_json
from snowsplat.data.readers.points import points_beside
from snowsplat.data.readers.reconstruction import PhotoFolder, Reader, Reconstruction
from snowsplat.scene.length import stored_metres
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.messages import Message, message
from snowsplat.util.safe_json import inside, is_file, quoted

# Images whose observations are read, spread over the model.
_MOST_IMAGES = 100
# Share of the observations of tracks that must name the point of their track. If it is less, the
# points or the images were replaced.
_LEAST_VALID = 0.5


def points_with_tracks(model: ColmapModel, names: Mapping[int, str]) -> Points | None:
    """The points of a model, with `Points.tracks` if its images have their observations.

    Args:
        model: of which the points are read.
        names: of views, by the ids of the images that are used.

    Raises: UserError: a file is damaged.
    """
    if (found := read_point_file(model.folder)) is None:
        return None
    path, file = found
    points = usable_points(path, file.xyz, file.rgb)
    if points is None or len(points) < len(file.xyz):  # those left out would have other rows
        return points
    return replace(points, tracks=_tracks(model, names, file))


def _tracks(model: ColmapModel, names: Mapping[int, str], file: PointFile) -> Tracks | None:
    seen = file.tracks[np.isin(file.tracks[:, 1], list(names))]
    images = np.unique(seen[:, 1])
    images = images[:: -(-len(images) // _MOST_IMAGES) or 1]
    seen = seen[np.isin(seen[:, 1], images)]
    if not len(seen):
        return None
    rows = {int(image): seen[seen[:, 1] == image] for image in images}
    observed = read_observations(model, {image: track[:, 2] for image, track in rows.items()})
    # In a damaged file, an image without a camera may have the number of another one.
    used = (image for image in model.images if image.camera_id in model.cameras)
    cameras = {image.number: model.cameras[image.camera_id] for image in used}
    rays, points, photos, valid = [], [], [], 0
    for number, (image, track) in enumerate(rows.items()):
        found = observed[image]
        known = found[:, 2] == file.ids[track[:, 0]]
        valid += int(known.sum())
        ray = cameras[image].unproject(found[known, :2])
        rays.append(ray)
        points.append(track[known, 0])
        photos.append(np.full(len(ray), number))
    if valid < _LEAST_VALID * len(seen):
        return None
    ray, point, photo = np.concatenate(rays), np.concatenate(points), np.concatenate(photos)
    usable = np.isfinite(ray).all(1)
    return Tracks([names[image] for image in rows], photo[usable], point[usable], ray[usable])


logger = logging.getLogger(__name__)


def find(root: Path, images: str, deep: bool = True) -> list[Path]:
    """The folders of the models of a dataset, the largest first."""
    models = find_models(root / "sparse")
    if not deep or transforms_json.find(root):
        return models
    models = models or find_models(root) or find_models(root / "colmap" / "sparse")
    if not (models and (root / images).is_dir()):  # dense/0/sparse, sfm …
        models = find_models_below(root, images) or models
    return models


def read(models: list[Path], photos: PhotoFolder) -> Reconstruction:
    """Read the first of ``models``: posed images that are on disk, and points.

    Raises: UserError: damaged files, or no images.
    """
    root, folder = photos.root, models[0]
    name = folder.relative_to(root).as_posix()
    if len(models) > 1:
        _warn_of_other_models(root, models)
    model = read_model(folder)
    if not model.images:
        raise UserError("{folder}: the COLMAP model has no images; run COLMAP again", folder=folder)
    description = message("COLMAP model {name} (binary)", name=name)
    if model.text:
        description = message("COLMAP model {name} (text)", name=name)
    found = Reconstruction(description=description)
    names = _add_images(found, workspace_of(folder, root, photos.images), photos.images, model)
    warn_of_unusable(folder, found.unusable, len(found.images))
    own = points_with_tracks(model, names)
    # Other programs write a denser cloud beside the model, and convert it to a PLY file.
    points_beside(folder, found, file="points3D.ply", more_than=0 if own is None else len(own))
    if found.points is None:
        found.points = own
    elif own is not None:  # whose tracks are evidence about the poses
        logger.warning(
            "%s: its %d points are used, too", folder / found.points_from, len(found.points)
        )
        found.points = replace(
            own,
            xyz=torch.cat([own.xyz, found.points.xyz.to(own.xyz)]),
            rgb=torch.cat([own.rgb, found.points.rgb]),
        )
    if found.points is None:
        logger.warning("%s: the model has no points; training starts from random ones", folder)
    placement = read_placement(root) if folder == root / "sparse" / "0" else None
    found.metres_per_unit = None if placement is None else stored_metres(placement.metres_per_unit)
    return found


def _warn_of_other_models(root: Path, models: Sequence[Path]) -> None:
    largest, *others = [(m.relative_to(root).as_posix(), count_images(m)) for m in models]
    logger.warning(
        "%s: COLMAP made %d separate models; using the largest, %s (%d images), not %s",
        root,
        len(models),
        *largest,
        ", ".join(f"{name} ({count})" for name, count in others),
    )


def _add_images(
    found: Reconstruction, root: Path, images: str, model: ColmapModel
) -> dict[int, str]:
    """Add the images of a model whose files exist; returns their names by image id; warns of those
    that are missing.

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
        for name, file in find_photos(model.folder, place, left, places.keys()).items():
            first = "" if place == folder else file.rpartition("/")[0].partition("/")[0]
            places[name] = (place / first, file.removeprefix(f"{first}/"), file)
    if not places:
        raise _no_images(root, images, model)
    names = {}
    for image in model.images:
        if image.name not in places:
            found.missing.append(image.name)
            continue
        where, file, name = places[image.name]
        with found.one(image.name):
            camera, lens = posed_camera(model, image), model.cameras[image.camera_id]
            frame = model.frames.get(image.number)
            names[image.number] = safe_name(name)
            found.images.append(
                PosedImage(
                    safe_name(name),
                    camera,
                    lens,
                    where,
                    file,
                    frame=None if frame is None else str(frame),
                )
            )
    warn_of_missing(folder, found.missing, len(model.images))
    return names


def _no_images(root: Path, images: str, model: ColmapModel) -> UserError:
    folder, first = root / images, quoted(model.images[0].name)
    if not folder.is_dir():
        found = sorted(p.name for p in root.iterdir() if p.is_dir())
        missing = message("no such folder: {folder}; use the right one", folder=folder)
        if found:
            missing = message("{missing} (existing folders: {found})", missing=missing, found=found)
        return SettingError("images", missing)
    names = photos_below(folder)
    instead = Message("")
    if names:
        one = quoted(names[0])
        instead = message("; it has {count} others, e.g. {name}", count=len(names), name=one)
    return SettingError(
        "images",
        "{folder} has none of the {images} images of the model (the first is {first}){instead}; "
        "use the right folder",
        folder=folder,
        images=len(model.images),
        first=first,
        instead=instead,
    )


READER = Reader("COLMAP", find, read)
