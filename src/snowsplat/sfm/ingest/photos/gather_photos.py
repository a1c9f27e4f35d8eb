"""Copies photos into ``input/``: chooses the file names, then checks, converts or copies the files.

First, `plan_photos` reads only the headers. Then `write_photos` decodes every photo.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from snowsplat.data.maps.mask_pixels import MaskLook, look_of
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.project.left_out import LeftOut
from snowsplat.sfm.ingest.content.panorama import (
    NOT_TWICE_AS_WIDE,
    Panorama,
    is_twice_as_wide,
    shows_all_around,
)
from snowsplat.sfm.ingest.content.sharpness import CONTENT_SIDE, grey_copy, why_unusable
from snowsplat.sfm.ingest.photo import Photo, free_name, not_used
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
from snowsplat.sfm.ingest.search.sources import Source
from snowsplat.sfm.options import GatherOptions
from snowsplat.sfm.progress import Report, in_threads
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
    sources: Sequence[Source], options: GatherOptions, left_out: list[LeftOut]
) -> list[Planned]:
    """Choose the name of each photo in ``input/``. Photos are sorted by this name.

    If two photos would have the same name, the one whose name need not change keeps it. Photos that
    cannot be used are appended to ``left_out``. If there are more photos than `options.photos`,
    they are spread evenly, and the last one is used.
    """
    read = []
    for source in sources:
        try:
            header = read_header(source.path)
            if options.as_stored:
                header = header.as_stored()
            if options.panoramas and header.panorama is None:
                if not is_twice_as_wide(*header.size(None)):
                    raise Unusable(NOT_TWICE_AS_WIDE)
                header = replace(header, panorama=Panorama())
        except Unusable as error:
            left_out.append(not_used(source.path, error.message))
            continue
        if header.animated > 1:
            reason = message(
                "is an animation of {n} pictures, of which one is used; save the others as photos "
                "or a video",
                n=header.animated,
            )
            left_out.append(not_used(source.path, reason))
        name = header.file_name(source.name, options.size)
        path = PurePosixPath(name)
        for page in header.pages:
            of_page = path.with_name(f"{path.stem}_page{page + 1:03d}{path.suffix}")
            read.append((str(of_page) if page else name, source, header, page))
    read.sort(key=lambda entry: (entry[0] != entry[1].name, entry[0]))
    taken = set[str]()
    planned = [Planned(source, header, free_name(n, taken), p) for n, source, header, p in read]
    planned.sort(key=lambda plan: natural_key(plan.name))
    count, last = options.photos, len(planned) - 1
    if count is None or count > last:
        return planned
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

    photos, looks = list[Photo](), list[MaskLook]()
    made = in_threads(work, planned, min(4, os.cpu_count() or 1), report)
    for plan, outcome in zip(planned, made, strict=True):
        if isinstance(outcome, Message):
            left_out.append(not_used(plan.source.path, outcome))
            continue
        photo, look = outcome
        photos.append(photo)
        looks += [] if look is None else [look]
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
    if used is not None and not used.any():
        raise Unusable("is completely masked out")
    grey = grey_copy(image.convert("RGB") if alpha else image, CONTENT_SIDE)
    reason = why_unusable(grey)
    if reason:
        raise Unusable(reason)
    width, height = header.size(longest)
    if panorama is not None and panorama.cropped:  # black rows where the photo has none
        above, below = panorama.rows(height)
        used = np.ones((height, width), bool) if used is None else used
        used = np.pad(used, ((above, below), (0, 0)))
        whole = Image.new(image.mode, (width, above + height + below))
        whole.paste(image, (0, above))
        image, height = whole, whole.height
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
        focal=None if exif.focal is None or around else exif.focal * scale,
        location=exif.location,
        mask=used is not None,
        alpha=alpha,
        location_error=exif.location_error,
        attitude=None if around else exif.attitude,  # of the device, not of the picture
        panorama=around,
        turned=header.turned,
    )
    look = None if used is None or source.mask is None else look_of(used)
    return photo, look
