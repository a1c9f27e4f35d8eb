"""Removes the lens distortion of photos, their masks and the SfM model.

    distorted/sparse/0, input/, distorted/masks/  ->  sparse/0, images/, masks/, images_2/ …

The new model has pinhole cameras and is in the frame of the scene (see `orient`). The files have
the layout that training reads.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image

from snowsplat.data.decode import resize_area
from snowsplat.data.image_file import open_image, reason_of
from snowsplat.data.image_loader import available_memory
from snowsplat.data.lens.pinhole import Pinhole, pinhole_of
from snowsplat.data.lens.resample import undistort_image, undistort_mask
from snowsplat.data.plain_pixels import plain_pixels
from snowsplat.sfm.pinhole_model import write_model
from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path

if TYPE_CHECKING:
    import pycolmap

    from snowsplat.scene.geometry import Similarity
    from snowsplat.sfm.ingest.photo import Photo
    from snowsplat.sfm.progress import Report

logger = logging.getLogger(__name__)

_DIVISORS = (2, 4, 8)
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

    name: str  # path relative to input/
    camera_size: tuple[int, int]  # width and height of the distorted camera
    pinhole: Pinhole
    mask: bool  # whether the photo has a mask


def undistort(
    dataset: Path,
    photos: Sequence[Photo],
    scene_from_sfm: Similarity,
    resize: bool,
    report: Report,
    threads: int | None = None,
) -> Undistorted:
    """Make ``images/``, ``masks/`` and ``sparse/0`` of a dataset whose poses are known.

    Photos without a pose are left out. Files keep their names and formats: JPEG is saved at quality
    95 without chroma subsampling, all others without loss, with transparency. If a camera has no
    distortion, its photos are copied. A mask is written for each photo that has one, unless all
    masked pixels are transparent in the image. The model is written last.

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

    model = pycolmap.Reconstruction(dataset / "distorted" / "sparse" / "0")
    pinholes = {number: _pinhole(camera) for number, camera in model.cameras.items()}
    known = {photo.name: photo for photo in photos}
    jobs = []
    for number in model.reg_image_ids():
        image = model.images[number]
        photo, camera = known.get(image.name), model.cameras[image.camera_id]
        masked = photo is not None and photo.mask
        size = (camera.width, camera.height)
        jobs.append(_Job(image.name, size, pinholes[image.camera_id], masked))
    jobs.sort(key=lambda job: job.name)
    divisors = _DIVISORS if resize else ()
    folders = ["images", *(f"images_{divisor}" for divisor in divisors)]
    pixels = max(p.width * p.height for p in pinholes.values())
    threads = min(
        threads or min(4, os.cpu_count() or 1),
        max(1, available_memory() // (2 * _BYTES_PER_PIXEL * pixels)),
    )
    masks = _run(
        [partial(_undistort_photo, dataset, job, divisors) for job in jobs], report, threads
    )
    write_model(model, pinholes, scene_from_sfm, dataset / "sparse")
    sizes = Counter((job.pinhole.width, job.pinhole.height) for job in jobs)
    return Undistorted(
        images=len(jobs),
        masks=sum(masks),
        sizes=[(*size, count) for size, count in sizes.most_common()],
        folders=folders,
        resampled=any(job.pinhole.nodes is not None for job in jobs),
    )


def _pinhole(camera: pycolmap.Camera) -> Pinhole:
    found = f"{camera.model_name} {', '.join(f'{value:.5g}' for value in camera.params)}"
    try:
        pinhole = pinhole_of(camera)
    except ValueError as error:
        raise UserError(
            f"lens distortion: implausible estimate ({found}): {error}; take more photos from "
            "different positions, or set another camera_model"
        ) from None
    if pinhole.cropped:
        logger.warning(
            "the estimated lens distortion (%s) is valid only near the centre of the photos, so "
            "images are cropped; another camera_model may keep more",
            found,
        )
    return pinhole


def _run(jobs: Sequence[Callable[[], bool]], report: Report, threads: int) -> list[bool]:
    """Run jobs in threads; returns their results in any order.

    After the first error or Ctrl-C, running jobs finish and the others are cancelled.
    """
    report(0, len(jobs), "photos")
    # Pillow and torch release the GIL while they compute. Each job uses torch with one thread.
    pool = ThreadPoolExecutor(threads, "snowsplat-undistort", torch.set_num_threads, (1,))
    try:
        results = []
        running = [pool.submit(job) for job in jobs]
        for done, future in enumerate(as_completed(running), 1):
            results.append(future.result())
            report(done, len(jobs), "photos")
        return results
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


# One photo


def _undistort_photo(dataset: Path, job: _Job, divisors: Sequence[int]) -> bool:
    """Write the image, its smaller copies and its mask; returns whether a mask was written."""
    source, target = dataset / "input" / job.name, dataset / "images" / job.name
    opaque = None
    with _open_photo(source, job) as opened:
        form = "JPEG" if opened.format == "MPO" else str(opened.format)
        if job.pinhole.nodes is None:
            with _atomic_path_in_new_folder(target) as temporary:
                shutil.copyfile(source, temporary)
        if job.pinhole.nodes is not None or divisors or job.mask:
            photo = _decode(opened, source)
            opaque = np.asarray(photo)[..., 3] > 0 if photo.mode == "RGBA" else None
        if job.pinhole.nodes is not None or divisors:
            image = undistort_image(photo, job.pinhole)
            if job.pinhole.nodes is not None:
                _save(image, target, form)
            for divisor in divisors:
                folder = dataset / f"images_{divisor}"
                _save(_reduced(image, divisor), folder / job.name, form)
    return job.mask and _undistort_mask(dataset, job, opaque)


def _undistort_mask(dataset: Path, job: _Job, opaque: np.ndarray | None) -> bool:
    """Write the mask, unless it masks only transparent pixels; returns whether it was written.

    ``opaque``: (H, W) bool, the pixels of the photo that are not transparent; None: all.
    """
    name = f"{job.name}.png"
    path = dataset / "distorted" / "masks" / name
    with _open_photo(path, job) as opened:
        mask = _decode(opened, path).convert("L")
    if opaque is not None:
        # SfM ignores transparent pixels; training uses them as empty space.
        used = (np.asarray(mask) >= 128) | ~opaque
        if used.all():
            return False
        mask = Image.fromarray(used.astype(np.uint8) * 255)
    _save(undistort_mask(mask, job.pinhole), dataset / "masks" / name, "PNG")
    return True


def _open_photo(path: Path, job: _Job) -> Image.Image:
    try:
        image = open_image(path, list(_SAVING))
    except FileNotFoundError:
        raise UserError(f"{path}: missing; restore it, or run sfm again") from None
    except Exception as error:  # Pillow may raise any exception for a damaged file
        raise UserError(f"{path}: cannot be read ({reason_of(error)}); replace it") from None
    if image.size != job.camera_size:
        image.close()
        raise UserError(
            f"{path}: size is {image.width}x{image.height}, but its pose was estimated at "
            f"{job.camera_size[0]}x{job.camera_size[1]}; restore the image, or run sfm again"
        )
    return image


def _decode(opened: Image.Image, path: Path) -> Image.Image:
    """Mode L or RGB, or RGBA if the image may have transparent pixels."""
    try:
        return plain_pixels(opened, path)
    except Exception as error:  # as in `_open_photo`
        raise UserError(f"{path}: cannot be decoded ({reason_of(error)}); replace it") from None


def _reduced(image: Image.Image, divisor: int) -> Image.Image:
    """The image at 1/``divisor`` of its size, averaged over areas; rounded as in `data`."""
    width, height = (max(1, round(side / divisor)) for side in image.size)
    # Premultiplied alpha, so that the colours of transparent pixels do not affect other pixels.
    mode = "RGBa" if image.mode == "RGBA" else image.mode
    pixels = np.asarray(image.convert(mode)).reshape(image.height, image.width, -1)
    planes = resize_area(np.ascontiguousarray(pixels.transpose(2, 0, 1)), width, height)
    small = np.ascontiguousarray(planes.transpose(1, 2, 0))
    return Image.frombytes(mode, (width, height), small.tobytes()).convert(image.mode)


def _atomic_path_in_new_folder(path: Path) -> AbstractContextManager[Path]:
    path.parent.mkdir(parents=True, exist_ok=True)
    return atomic_path(path)


def _save(image: Image.Image, path: Path, form: str) -> None:
    """Save without metadata: the colours are those of sRGB."""
    with _atomic_path_in_new_folder(path) as temporary:
        image.save(temporary, form, icc_profile=None, **_SAVING[form])
