"""Computes the `SfmResult` from COLMAP models: which photos have a pose, and how good they are."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.sfm.colmap.options import SfmResult
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.limited_child import check_readable
from snowsplat.util.messages import message
from snowsplat.util.safe_json import inside, quoted


def result_of(
    models: Sequence[pycolmap.Reconstruction],
    photos: Sequence[Photo],
    exif: bool = True,
    held: bool = False,
    **found: Any,
) -> SfmResult:
    """The result with the statistics of the first of ``models`` (at least one, the largest first).

    Args:
        exif: the focal length in EXIF was used.
        held: the focal length was not refined.
        found: the fields of `SfmResult` that the models do not tell.
    """
    model, names = models[0], names_in(models[0])
    with_focal = {photo.name for photo in photos if photo.focal and exif}
    cameras = []
    for camera_id, camera in sorted(model.cameras.items()):
        taken = {n for n in names if model.find_image_with_name(n).camera_id == camera_id}
        if taken:
            cameras.append(
                {
                    "model": camera.model_name,
                    "width": camera.width,
                    "height": camera.height,
                    "params": [float(value) for value in camera.params],
                    "focal_from": "exif" if taken & with_focal else "guessed",
                    "focal_held": held,
                    "images": len(taken),
                }
            )
    # The points of two photos have small errors even if a pose is slightly wrong.
    errors = [p.error for p in model.points3D.values() if p.track.length() > 2]
    return SfmResult(
        registered=sorted(names),
        points=model.num_points3D(),
        observations=model.compute_num_observations(),
        reprojection_error=float(np.mean(errors)) if errors else 0.0,
        sub_models=[m.num_reg_images() for m in models],
        cameras=cameras,
        **found,
    )


def names_in(model: pycolmap.Reconstruction) -> set[str]:
    """The names of the photos that have a pose in ``model``."""
    return {model.image(image_id).name for image_id in model.reg_image_ids()}


def describe_model(dataset: Path, photos: Sequence[Photo]) -> SfmResult:
    """Statistics of existing models in ``distorted/sparse``; these may be from an unknown source.

    Raises: UserError: there is no model, or the first one is damaged, has none of ``photos``, or
    has photos outside of ``input/``.
    """
    files = DatasetFolder(dataset)
    sparse = files.distorted_models
    numbered = sorted(
        (p for p in sparse.glob("*") if p.name.isdecimal()), key=lambda p: int(p.name)
    )
    if not numbered or numbered[0].name != "0":
        raise _cannot_skip(f"there is no COLMAP model in {sparse / '0'}")
    models = []
    for folder in numbered:
        try:
            check_readable(read_model, folder, ["pycolmap"])
        except UserError:
            raise _cannot_skip(
                f"the COLMAP model in {folder} is damaged or not supported"
            ) from None
        models.append(read_model(folder))
    names = names_in(models[0])
    for name in names:
        # `undistort` uses these names as paths.
        if inside(files.photos, name) is None:
            raise _cannot_skip(
                f"the model in {numbered[0]} has a photo {quoted(name)} outside of {files.photos}"
            )
    if not names & {photo.name for photo in photos}:
        raise _cannot_skip(f"the model in {numbered[0]} has none of the photos in {files.photos}")
    missing = message("it is not in the existing model")
    unregistered = {photo.name: missing for photo in photos if photo.name not in names}
    pairs = "not matched: the model existed already"
    return result_of(models, photos, unregistered=unregistered, pairs=pairs, attempts=[])


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """A model of COLMAP; everything that `result_of` uses of it has been computed once."""
    model = pycolmap.Reconstruction(folder)
    model.update_point_3d_errors()
    model.compute_mean_reprojection_error()
    for number in model.reg_image_ids():
        camera = model.cameras[model.images[number].camera_id]
        if not camera.is_spherical():  # a panorama has no such matrix
            camera.calibration_matrix()
    return model


def _cannot_skip(reason: str) -> UserError:
    return SettingError("skip_matching", "{reason}; run without this setting", reason=reason)
