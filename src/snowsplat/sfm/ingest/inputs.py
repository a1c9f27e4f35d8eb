"""Fills ``input/`` of a dataset with photos and video frames, and ``distorted/masks`` with masks.

Files in ``input/`` are upright, in a format that COLMAP reads, and have been decoded once as a
check. Images without content are skipped and reported; at least three images must remain.
"""

import errno
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from snowsplat.data.maps.mask_pixels import doubt_about_masks
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.project.left_out import LeftOut
from snowsplat.sfm.ingest.content.panorama import STITCHED, is_twice_as_wide, spherical_video
from snowsplat.sfm.ingest.content.sharpness import BLACK, BLURRED, FLAT, WHITE
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.ingest.photos.gather_photos import Planned, plan_photos, write_photos
from snowsplat.sfm.ingest.photos.set_aside import set_fixed_parts_aside
from snowsplat.sfm.ingest.search.sources import Source, Sources, find_sources
from snowsplat.sfm.ingest.video.clip import Clip, max_frame_count, read_clip
from snowsplat.sfm.ingest.video.video_frames import SAME_VIEW, extract_frames
from snowsplat.sfm.options import MIN_PHOTOS, GatherOptions
from snowsplat.sfm.progress import Report
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.files import shown
from snowsplat.util.messages import Message, message, plural
from snowsplat.util.names import first_names
from snowsplat.util.natural_order import natural_key

logger = logging.getLogger(__name__)

_NAMED = 3  # photos that an error names
_COLOURS = {BLACK: message("black"), WHITE: message("white"), FLAT: message("of one colour")}
#: The error if most images are unusable for one of these reasons.
_ADVICE = {
    SAME_VIEW: message(
        "{video}: the camera does not move ({who} show the same view), but depth needs motion; "
        "film while walking around the scene"
    ),
    STITCHED: message(
        "photos: {who} are stitched panoramas, which no lens has taken; use the single photos, or "
        "panoramas of all directions (equirectangular, twice as wide as high)"
    ),
    BLURRED: message(
        "photos: {who} are too blurred to be matched; hold the camera still for each photo, in "
        "good light and in focus"
    ),
    **dict.fromkeys(
        _COLOURS,
        message("photos: {who} are completely {what}; check the lens cap, the light and the files"),
    ),
}


@dataclass(frozen=True)
class Gathered:
    """The usable photos and frames, in natural order of names, and the others."""

    photos: list[Photo]
    left_out: list[LeftOut]
    notes: list[Message]  # lines for the user about what was cropped and masked


def gather(
    inputs: Sequence[Path] | Sources, dataset: Path, options: GatherOptions, report: Report
) -> Gathered:
    """Fill ``input/`` of a dataset and, for masks and transparency, ``distorted/masks``.

    If one of ``inputs`` is ``input/`` itself, its photos are used in place and never changed. Then
    all photos must be upright (unless ``as_stored``), in a format that COLMAP reads, and not larger
    than the requested size.

    Photos of one folder form a group, which shares intrinsics, if they have the same size, camera
    and focal length in EXIF. Portrait and landscape photos of one phone are in different groups:
    when upright, their width and height differ. Each video is a group.

    Args:
        inputs: photos, folders and videos, or what `find_sources` has found in them.

    Raises:
        UserError: fewer than three usable photos, a mask whose size differs from its photo, a full
            disk, or photos used in place that would have to be changed.
        OSError: the dataset cannot be written.
    """
    if options.fps is not None and options.frames is not None:
        raise SettingError("fps", "cannot be combined with frames; set only one of them")
    sources = inputs if isinstance(inputs, Sources) else find_sources(inputs)
    folder = DatasetFolder(dataset).photos
    for note in sources.notes:
        logger.warning("%s", note)
    left_out = list(sources.left_out)
    in_place = sources.contain(folder)
    planned = plan_photos(sources.photos, options, left_out)
    _warn_of_cropped(planned)
    clips = [(video, read_clip(video.path)) for video in sources.videos]
    around = [_shows_all_around(clip, options) for _, clip in clips]
    if in_place:
        _refuse_changes(planned, sources.videos, options)
    folder.mkdir(parents=True, exist_ok=True)
    notes: list[Message] = []
    try:
        photos, looks = write_photos(planned, dataset, options.size, in_place, left_out, report)
        photos = _with_panoramas(photos)
        for (source, clip), panorama in zip(clips, around, strict=True):
            photos += _take_frames(source, clip, folder, options, panorama, left_out, notes, report)
        photos.sort(key=lambda photo: natural_key(photo.name))
        photos, found = set_fixed_parts_aside(photos, dataset, in_place)
        notes += found
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise UserError(
                "disk: full; free some space, or set a smaller size, e.g. 1600"
            ) from None
        raise
    if sources.unused_masks:
        logger.warning(
            "%s",
            message(
                "{mask}: mask not used, there is no such photo ({count} such masks); the mask of "
                "IMG.jpg is masks/IMG.png, IMG.jpg.png or IMG_mask.png",
                mask=shown(sources.unused_masks[0]),
                count=len(sources.unused_masks),
            ),
        )
    if doubt := doubt_about_masks(looks):
        logger.warning("warning: %s", doubt)
    if len(photos) < MIN_PHOTOS:
        raise _too_few(len(photos), left_out)
    return Gathered(photos, left_out, notes)


def _warn_of_cropped(planned: Sequence[Planned]) -> None:
    """The photos of a lens share its axis; a program moves it, for each photo elsewhere."""
    cropped = [plan for plan in planned if plan.header.exif.cropped and not plan.header.panorama]
    if cropped:
        logger.warning(
            "%s",
            message(
                "{count} of {all} photos were cropped after they were taken (such as {name}); if "
                "each was cropped elsewhere, poses are worse; use the originals",
                count=len(cropped),
                all=len(planned),
                name=cropped[0].name,
            ),
        )


def _with_panoramas(photos: list[Photo]) -> list[Photo]:
    """The photos; those of a panorama's size are panoramas if most of this size are. Not every
    panorama is recognised by its pixels: there may be an edge at a pole."""
    alike = [photo for photo in photos if is_twice_as_wide(photo.width, photo.height)]
    if 2 * sum(photo.panorama for photo in alike) < len(alike):
        return photos
    return [
        replace(photo, panorama=True, group=f"{photo.group} panorama", focal=None, attitude=None)
        if photo in alike and not photo.panorama
        else photo
        for photo in photos
    ]


def _shows_all_around(clip: Clip, options: GatherOptions) -> bool:
    """Whether the frames of a video are 360° panoramas, by the header of the file.

    Raises: UserError: they show all directions, but not as one equirectangular picture.
    """
    found = spherical_video(clip.path)
    around = found is not None or options.panoramas
    problem = found or ""
    if around and not problem and not is_twice_as_wide(clip.width, clip.height):
        problem = f"has frames of {clip.width}x{clip.height} pixels"
    if problem:
        raise UserError(
            "{path}: is a 360° video that {problem}; export it with one equirectangular picture "
            "of all directions, which is twice as wide as high",
            path=shown(clip.path),
            problem=problem,
        )
    return around


def _refuse_changes(
    planned: Sequence[Planned], videos: Sequence[Source], options: GatherOptions
) -> None:
    """Raises UserError if a photo cannot be used in place, or if the inputs contain a video."""
    changed = [plan.source.path for plan in planned if not plan.header.is_ready(options.size)]
    others = [source.path for source in videos]
    others += [plan.source.path for plan in planned if plan.name != plan.source.name]
    for path in [*changed, *others]:
        raise UserError(
            "{path}: must be converted, rotated or resized, but files in input/ are never "
            "changed; make a dataset in a new folder instead",
            path=shown(path),
        )


# Videos


def _take_frames(
    source: Source,
    clip: Clip,
    folder: Path,
    options: GatherOptions,
    panorama: bool,
    left_out: list[LeftOut],
    notes: list[Message],
    report: Report,
) -> list[Photo]:
    frame_folder = folder / source.name
    frame_folder.mkdir(parents=True, exist_ok=True)
    max_frames = max_frame_count(clip, options.fps, options.frames)
    frames = extract_frames(clip, frame_folder, max_frames, options.size, report, panorama)
    label = source.path.name if not source.name else source.name
    notes += [message("{video}: {line}", video=label, line=line) for line in frames.notes]
    left_out += [
        LeftOut(f"{label} at {seconds:.1f} s", "photos", reason)
        for seconds, reason in frames.skipped
    ]
    return [
        Photo(
            name=str(PurePosixPath(source.name) / frame.name),
            source=f"{label} at {frame.seconds:.1f} s",
            width=frame.width,
            height=frame.height,
            group=f"{label} {frame.width}x{frame.height}" + " panorama" * frames.panoramas,
            sequence=label,
            panorama=frames.panoramas,
        )
        for frame in frames.kept
    ]


# Errors


def _too_few(usable: int, left_out: Sequence[LeftOut]) -> UserError:
    """The error if too few images are usable; it explains the most frequent reason."""
    reasons = Counter(each.reason for each in left_out)
    reason, often = reasons.most_common(1)[0] if reasons else ("", 0)
    everything = usable == 0 and often == len(left_out)
    who = message("all {n} images", n=often)
    if not everything:
        who = message("{n} of {all} images", n=often, all=usable + len(left_out))
    if often < 2 or often < len(left_out) / 2:
        some = [message("{photo} {why}", photo=each.photo, why=each.reason) for each in left_out]
        reasons_of_some = message("; {reasons}", reasons=first_names(some, _NAMED)) if some else ""
        return UserError(
            "photos: {count}; use at least {min_photos}, preferably 20 or more, from different "
            "places around the scene{left_out}",
            count=_count(usable),
            min_photos=MIN_PHOTOS,
            left_out=reasons_of_some,
        )
    if reason in _ADVICE:
        video = left_out[0].photo.partition(" at ")[0]
        values = {"who": who, "video": video, "what": _COLOURS.get(reason, "")}
        return UserError(Message(_ADVICE[reason].key, values))
    first = next(each.photo for each in left_out if each.reason == reason)
    return UserError(
        "photos: {count}; {who} cannot be used, e.g. {first}, which {reason}; use at least "
        "{min_photos}, preferably 20 or more",
        count=_count(usable),
        who=who,
        first=first,
        reason=reason,
        min_photos=MIN_PHOTOS,
    )


def _count(usable: int) -> Message:
    if usable == 0:
        return message("no usable image")
    return plural("only {n} usable image", "only {n} usable images", n=usable)
