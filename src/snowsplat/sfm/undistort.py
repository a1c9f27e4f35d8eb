"""Removes the lens distortion of photos, their masks and the SfM model.

    distorted/sparse/0, input/, distorted/masks/  ->  sparse/0, images/, masks/, images_2/ …

The new model has pinhole cameras and is in the frame of the scene (see `orient`). The files have
the layout that training reads. A photo of a lens with a field of view of more than 120° becomes
several images, "NAME_front.jpg", "NAME_left.jpg" …
"""

from __future__ import annotations

import logging
import os
import shutil
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image

from snowsplat.data.lens.coverage import covered_pixels
from snowsplat.data.lens.models import lens_of
from snowsplat.data.lens.resample import undistort_image, undistort_mask
from snowsplat.data.lens.views import LensView, lens_views, pinhole_view
from snowsplat.data.photos.colour_profile import plain_pixels
from snowsplat.data.photos.decode import resize_area
from snowsplat.data.photos.image_file import open_image, reason_of
from snowsplat.data.photos.image_loader import available_memory
from snowsplat.project.dataset_folder import IMAGE_FOLDERS, DatasetFolder
from snowsplat.sfm.pinhole_model import in_views, view_name, write_model
from snowsplat.sfm.progress import Report, in_threads
from snowsplat.util.errors import UserError
from snowsplat.util.files import make_parent, new_entries

if TYPE_CHECKING:
    import pycolmap

    from snowsplat.scene.geometry import Similarity
    from snowsplat.sfm.ingest.photo import Photo

logger = logging.getLogger(__name__)

_DIVISORS = (2, 4, 8)
_MASKS = 8  # of a camera that are examined for an image circle
_CIRCLE = 0.95  # radius of an image circle / distance of the corner of a photo, at most
_FULL = 0.9  # share of the pixels in an image circle that are used in some photo, at least
_BYTES_PER_PIXEL = 50  # peak memory per photo, reached while it is resized
# Options for saving each format, without a loss that affects training.
_SAVING: dict[str, dict[str, Any]] = {
    "JPEG": {"quality": 95, "subsampling": 0},
    "PNG": {"compress_level": 3},
    "WEBP": {"lossless": True},
    "TIFF": {"compression": "tiff_deflate"},
    "BMP": {},
    "PPM": {},
}


@dataclass(frozen=True)
class Undistorted:
    """The images that were written. All fields can be stored as JSON."""

    images: int
    masks: int
    sizes: list[tuple[int, int, int]]  # width, height, and the number of images of this size
    folders: list[str]  # names of the folders with images
    resampled: bool  # False if no camera has distortion: then the images are copies of the photos


@dataclass(frozen=True)
class _Job:
    """One photo to undistort."""

    dataset: DatasetFolder
    name: str  # path relative to input/
    camera_size: tuple[int, int]  # width and height of the distorted camera
    views: Sequence[tuple[str, LensView]]  # the images of the photo, and their names
    mask: bool  # whether the photo has a mask
    divisors: Sequence[int]  # of the sizes of smaller copies

    @property
    def resampled(self) -> bool:
        """Whether the image differs from the photo."""
        return not all(view.is_photo for _, view in self.views)

    def decode(self, path: Path) -> tuple[Image.Image, str]:
        """The photo, or its mask, in mode L or RGB, or RGBA if it may have transparent pixels; and
        its format. Raises UserError: it is missing or damaged, or has another size."""
        try:
            with open_image(path, list(_SAVING)) as opened:
                form, size = str(opened.format), opened.size
                image = plain_pixels(opened, path) if size == self.camera_size else opened
        except FileNotFoundError:
            raise UserError("{path}: missing; restore it, or run sfm again", path=path) from None
        except Exception as error:  # Pillow may raise any exception for a damaged file
            raise UserError(
                "{path}: cannot be read ({reason_of}); replace it",
                path=path,
                reason_of=reason_of(error),
            ) from None
        if size != self.camera_size:
            raise UserError(
                "{path}: size is {width}x{height}, but its pose was estimated at "
                "{camera_size}x{camera_size2}; restore the image, or run sfm again",
                path=path,
                width=size[0],
                height=size[1],
                camera_size=self.camera_size[0],
                camera_size2=self.camera_size[1],
            )
        return image, "JPEG" if form == "MPO" else form


def undistort(
    dataset: Path,
    photos: Sequence[Photo],
    scene_from_sfm: Similarity,
    resize: bool,
    report: Report,
    threads: int | None = None,
) -> Undistorted:
    """Make ``images/``, ``masks/`` and ``sparse/0`` of a dataset whose poses are known.

    Photos without a pose are left out. Those of a wide lens and panoramas become several images;
    see `in_views`. Files keep their names and formats: JPEG is saved at quality
    95 without chroma subsampling, all others without loss, with transparency. If a camera has no
    distortion, its photos are copied. A mask is written for each photo that has one, unless all
    masked pixels are transparent in the image. What an earlier run has made there is replaced when
    all is complete, the model last.

    Args:
        photos: the photos in ``input/``.
        resize: also make ``images_2``, ``images_4`` and ``images_8``.
        threads: number of threads; None: one per core, at most 4. Fewer threads are used if the
            available memory is not sufficient for photos of this size.

    Raises:
        UserError: a photo is missing, damaged or changed; the calibration is implausible.
        OSError: the disk is full.
    """
    import pycolmap

    folder = DatasetFolder(dataset)
    model = pycolmap.Reconstruction(folder.distorted_model)
    masked = {photo.name for photo in photos if photo.mask}
    registered = [model.images[number] for number in sorted(model.reg_image_ids())]
    views = dict[int, Sequence[LensView]]()
    for number, camera in model.cameras.items():
        names = [image.name for image in registered if image.camera_id == number]
        views[number] = _views_of(camera, [folder.mask_of(n) for n in names if n in masked])
    divisors = _DIVISORS if resize else ()
    jobs = []
    for image in registered:
        camera = model.cameras[image.camera_id]
        size = (camera.width, camera.height)
        named = [(view_name(image.name, view), view) for view in views[image.camera_id]]
        jobs.append(_Job(folder, image.name, size, named, image.name in masked, divisors))
    jobs.sort(key=lambda job: job.name)
    count = Counter(name for job in jobs for name, _ in job.views)
    for name in (name for name, times in count.items() if times > 1):
        raise UserError(
            "{name}: is the name of a photo and of a part of one; rename this photo",
            name=folder.images / name,
        )
    sizes = Counter((view.width, view.height) for job in jobs for _, view in job.views)
    pixels = max(w * h for w, h in (*(job.camera_size for job in jobs), *sizes))
    threads = min(
        threads or min(4, os.cpu_count() or 1),
        max(1, available_memory() // (2 * _BYTES_PER_PIXEL * pixels)),
    )
    report(0, len(jobs), "photos")
    wide = {number: some for number, some in views.items() if some[0].rotation is not None}
    pinholes = {number: some[0] for number, some in views.items() if number not in wide}
    with new_entries(dataset, IMAGE_FOLDERS) as new:
        work = partial(_undistort_photo, DatasetFolder(new))
        # Pillow and torch release the GIL while they compute. Each job uses torch with one thread.
        masks = in_threads(work, jobs, threads, report, partial(torch.set_num_threads, 1))
        if wide:
            model = in_views(model, wide)
        write_model(model, pinholes, scene_from_sfm, new / "sparse")
    return Undistorted(
        images=sum(sizes.values()),
        masks=sum(masks),
        sizes=[(*size, count) for size, count in sizes.most_common()],
        folders=["images", *(f"images_{divisor}" for divisor in divisors)],
        resampled=any(job.resampled for job in jobs),
    )


def _views_of(camera: pycolmap.Camera, masks: Sequence[Path]) -> Sequence[LensView]:
    """The pinhole views of a lens: several, turned ones if its field of view is more than 120°.

    A panorama has six, the sides of a cube with a margin.

    ``masks``: of photos of the camera. If they mask what is outside of an image circle, the views
    show only the circle.
    """
    lens = lens_of(camera.model_name, camera.width, camera.height, camera.params)
    found = f"{camera.model_name} {', '.join(f'{value:.5g}' for value in camera.params)}"
    with suppress(ValueError):  # then `pinhole_view` decides: a part of the photo, or an error
        fisheye = not (camera.is_spherical() or camera.is_perspective_pinhole())
        views = lens_views(lens, _circle(camera, masks) if fisheye else None)
        if views[0].rotation is not None:
            return views
    try:
        view = pinhole_view(lens)
    except ValueError as error:
        raise UserError(
            "lens distortion: implausible estimate ({found}): {error}; take more photos from "
            "different positions, or set another camera_model",
            found=found,
            error=error,
        ) from None
    if view.cropped:
        logger.warning(
            "the estimated lens distortion (%s) is valid only near the centre of the photos, so "
            "images are cropped; another camera_model may keep more",
            found,
        )
    return (view,)


def _circle(camera: pycolmap.Camera, masks: Sequence[Path]) -> float | None:
    """The radius in pixels, around the principal point, outside of which all is masked; or None."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    radius = np.hypot(x - camera.principal_point_x, y - camera.principal_point_y)
    reach, inside = 0.0, np.zeros(radius.shape, bool)
    for path in masks[:: max(1, len(masks) // _MASKS)]:
        with open_image(path, ["PNG"]) as mask:
            used = np.asarray(mask.convert("L")) >= 128
        if used.shape != radius.shape or not used.any():
            return None
        reach, inside = max(reach, float(radius[used].max())), inside | used
    # The masks of something in the middle of the photos are no image circle: they do not fill it.
    is_full = inside[radius < reach].mean() >= _FULL
    return reach if 0 < reach < _CIRCLE * radius.max() and is_full else None


# One photo


def _undistort_photo(made: DatasetFolder, job: _Job) -> int:
    """Write the images, their smaller copies and their masks; returns the number of masks."""
    source, opaque = job.dataset.photos / job.name, None
    photo, form = job.decode(source)
    if photo.mode == "RGBA":
        opaque = np.asarray(photo)[..., 3] > 0
    if not job.resampled:
        make_parent(made.images / job.name)
        shutil.copyfile(source, made.images / job.name)
    for name, view in job.views if job.resampled or job.divisors else ():
        image = undistort_image(photo, view)
        if job.resampled:
            _save(image, made.images / name, form)
        for divisor in job.divisors:
            folder = made.path / f"images_{divisor}"
            _save(_reduce(image, divisor), folder / name, form)
    return _undistort_masks(made, job, opaque)


def _undistort_masks(made: DatasetFolder, job: _Job, opaque: np.ndarray | None) -> int:
    """Write the masks of the images of a photo; returns their number.

    A mask of transparent pixels only, and one of no pixels of a view, is not written. ``opaque``:
    (H, W) bool, the pixels of the photo that are not transparent; None: all.
    """
    mask = job.decode(job.dataset.mask_of(job.name))[0].convert("L") if job.mask else None
    if mask is not None and opaque is not None:
        # SfM ignores transparent pixels; training uses them as empty space.
        mask = _mask_of((np.asarray(mask) >= 128) | ~opaque)
    written = 0
    for name, view in job.views:
        kept = None if mask is None else undistort_mask(mask, view)
        if view.rotation is not None:  # the pixels that show nothing of the photo are masked
            used = covered_pixels(view, view.width, view.height)
            kept = _mask_of(used if kept is None else used & (np.asarray(kept) >= 128))
        if kept is not None:
            _save(kept, made.masks / f"{name}.png", "PNG")
            written += 1
    return written


def _mask_of(used: np.ndarray) -> Image.Image | None:
    """A mask of the pixels ``used`` (H, W) bool; None: all of them are."""
    return None if used.all() else Image.fromarray(used.astype(np.uint8) * 255)


def _reduce(image: Image.Image, divisor: int) -> Image.Image:
    """The image at 1/``divisor`` of its size, averaged over areas; rounded as in `data`."""
    width, height = (max(1, round(side / divisor)) for side in image.size)
    # Premultiplied alpha, so that the colours of transparent pixels do not affect other pixels.
    mode = "RGBa" if image.mode == "RGBA" else image.mode
    pixels = np.asarray(image.convert(mode)).reshape(image.height, image.width, -1)
    planes = resize_area(np.ascontiguousarray(pixels.transpose(2, 0, 1)), width, height)
    small = np.ascontiguousarray(planes.transpose(1, 2, 0))
    return Image.frombytes(mode, (width, height), small.tobytes()).convert(image.mode)


def _save(image: Image.Image, path: Path, form: str) -> None:
    """Save without metadata: the colours are those of sRGB."""
    make_parent(path)
    image.save(path, form, icc_profile=None, **_SAVING[form])
