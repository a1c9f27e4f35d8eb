"""Copies photos into ``input/``: chooses the file names, then checks, converts or copies the files.

First, `plan_photos` reads only the headers. Then `write_photos` decodes every photo.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from snowsplat.data.maps.mask_look import MaskLook, look_of
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.project.left_out import LeftOut
from snowsplat.sfm.ingest.content.panorama import (
    NOT_TWICE_AS_WIDE,
    Panorama,
    is_twice_as_wide,
    shows_all_around,
)
from snowsplat.sfm.ingest.content.sharpness import CONTENT_SIDE, grey_copy, why_unusable
from snowsplat.sfm.ingest.photo import Photo, not_used
from snowsplat.sfm.ingest.photos.mask_files import read_mask, write_mask
from snowsplat.sfm.ingest.photos.photo_files import (
    Header,
    Unusable,
    decode,
    decode_small,
    link_or_copy,
    read_header,
    save,
)
from snowsplat.sfm.ingest.search.names import free_names
from snowsplat.sfm.ingest.search.sources import Source
from snowsplat.sfm.progress import Report
from snowsplat.util.files import shown
from snowsplat.util.messages import Message, message
from snowsplat.util.natural_order import natural_key


@dataclass(frozen=True)
class Planned:
    """A photo that will be written to ``input/``, and the name that it gets there."""

    source: Source
    header: Header
    name: str  # relative to input/
    page: int = 0  # of the file


def plan_photos(
    sources: Sequence[Source],
    longest: int | None,
    left_out: list[LeftOut],
    panoramas: bool = False,
    as_stored: bool = False,
) -> list[Planned]:
    """Choose the name of each photo in ``input/``. Photos are sorted by this name.

    If two photos would have the same name, the one whose name need not change keeps it. Photos that
    cannot be used are appended to ``left_out``.

    Args:
        panoramas: all photos are 360° panoramas, even if their metadata do not say so.
        as_stored: the pixels are used as stored; see `Header.as_stored`.
    """
    read = []
    for source in sources:
        try:
            header = read_header(source.path)
            if as_stored:
                header = header.as_stored()
            if panoramas:
                header = _as_panorama(header)
        except Unusable as error:
            left_out.append(not_used(source.path, error.message))
        else:
            if header.animated > 1:
                reason = message(
                    "is an animation of {n} pictures, of which one is used; save the others as "
                    "photos or a video",
                    n=header.animated,
                )
                left_out.append(not_used(source.path, reason))
            name = header.file_name(source.name, longest)
            read += [(_page_name(name, page), source, header, page) for page in header.pages]
    read.sort(key=lambda entry: (entry[0] != entry[1].name, entry[0]))
    names = free_names([entry[0] for entry in read])
    planned = [Planned(s, h, name, p) for name, (_, s, h, p) in zip(names, read, strict=True)]
    return sorted(planned, key=lambda plan: natural_key(plan.name))


def _page_name(name: str, page: int) -> str:
    path = PurePosixPath(name)
    return str(path.with_name(f"{path.stem}_page{page + 1:03d}{path.suffix}")) if page else name


def _as_panorama(header: Header) -> Header:
    """The header of a panorama. Raises Unusable if the photo cannot be one."""
    if header.panorama is None and not is_twice_as_wide(*header.size(None)):
        raise Unusable(NOT_TWICE_AS_WIDE)
    return replace(header, panorama=header.panorama or Panorama())


def spread_evenly(planned: Sequence[Planned], count: int) -> list[Planned]:
    """At most ``count`` of the photos, at equal distances in their order, and the last one."""
    if count >= len(planned):
        return list(planned)
    last = len(planned) - 1
    return [planned[round(i * last / max(1, count - 1))] for i in range(count)]


def write_photos(
    planned: Sequence[Planned],
    dataset: Path,
    longest: int | None,
    in_place: bool,
    left_out: list[LeftOut],
    report: Report,
) -> tuple[list[Photo], list[MaskLook]]:
    """Write photos to ``input/``, and their masks to ``distorted/masks``, in up to four threads.

    Each thread has one photo in memory. The photos have the order of ``planned``, and so have the
    looks of the masks of some of them. Photos that cannot be used are appended to ``left_out``.

    Args:
        longest: largest allowed longest side in pixels; None: any.
        in_place: the photos are in ``input/`` already; write only the masks.
    """

    def work(plan: Planned) -> tuple[Photo, MaskLook | None] | Message:
        try:
            return _write_photo(plan, dataset, longest, in_place)
        except Unusable as error:
            return error.message

    photos, looks = [], []
    pool = ThreadPoolExecutor(min(4, os.cpu_count() or 1), thread_name_prefix="snowsplat-photos")
    try:
        for done, (plan, outcome) in enumerate(
            zip(planned, pool.map(work, planned), strict=True), 1
        ):
            if isinstance(outcome, Message):
                left_out.append(not_used(plan.source.path, outcome))
            else:
                photos.append(outcome[0])
                looks += [look for look in outcome[1:] if look is not None]
            report(done, len(planned), "photos")
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return photos, looks


def _write_photo(
    plan: Planned, dataset: Path, longest: int | None, in_place: bool
) -> tuple[Photo, MaskLook | None]:
    source, header = plan.source, plan.header
    target = DatasetFolder(dataset).photos / plan.name
    ready = header.is_ready(longest)
    if ready and not header.transparent:
        image = decode_small(source.path, CONTENT_SIDE)
    else:
        image = decode(source.path, header, longest, plan.page)
    used = read_mask(source.mask, header, header.size(longest)) if source.mask else None
    panorama = header.panorama or (Panorama() if shows_all_around(image) else None)
    alpha = image.mode == "RGBA"
    if alpha:
        opaque = np.asarray(image.getchannel("A")) > 0
        used = opaque if used is None else used & opaque
    _check_content(image, used)
    width, height = header.size(longest)
    if panorama is not None and panorama.cropped:
        image, used = _with_missing_rows(image, used, panorama)
        width, height = image.size
    if not in_place:
        target.parent.mkdir(parents=True, exist_ok=True)
        if ready:
            link_or_copy(source.path, target)
        else:
            save(image, target, source.path)
    if used is not None:
        write_mask(DatasetFolder(dataset).mask_of(plan.name), used)
    exif = header.exif
    scale = max(width, height) / max(header.width, header.height)
    folder = str(PurePosixPath(plan.name).parent)
    around = panorama is not None
    kind = "panorama" if around else ""
    photo = Photo(
        name=plan.name,
        source=shown(source.path),
        width=width,
        height=height,
        group=" ".join(filter(None, [f"{folder}/", exif.camera, f"{width}x{height}", kind])),
        sequence=None,
        focal=None if exif.focal is None or around else exif.focal * scale,
        location=exif.location,
        mask=used is not None,
        alpha=alpha,
        location_error=exif.location_error,
        attitude=None if around else exif.attitude,  # of the device, not of the picture
        panorama=around,
        turned=header.turned,
    )
    return photo, None if used is None or source.mask is None else look_of(used)


def _with_missing_rows(
    image: Image.Image, used: np.ndarray | None, panorama: Panorama
) -> tuple[Image.Image, np.ndarray]:
    """The whole panorama with black rows where the photo has none, and the used pixels (H, W)."""
    above, below = panorama.rows(image.height)
    if used is None:
        used = np.ones((image.height, image.width), bool)
    whole = Image.new(image.mode, (image.width, above + image.height + below))
    whole.paste(image, (0, above))
    return whole, np.pad(used, ((above, below), (0, 0)))


def _check_content(image: Image.Image, used: np.ndarray | None) -> None:
    """Raises Unusable if the photo has no content, or if no pixel is ``used`` (H, W) bool."""
    if used is not None and not used.any():
        raise Unusable("is completely masked out")
    grey = grey_copy(image.convert("RGB") if image.mode == "RGBA" else image, CONTENT_SIDE)
    reason = why_unusable(grey)
    if reason:
        raise Unusable(reason)
