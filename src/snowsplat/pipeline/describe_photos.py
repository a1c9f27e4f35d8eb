"""`describe_photos`: what `sfm` and `make` would use of photos and videos, and what not."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from snowsplat.data.maps.mask_pixels import doubt_about_files
from snowsplat.data.photos.suffixes import PHOTO_SUFFIXES, VIDEO_SUFFIXES
from snowsplat.data.readers.projects import advice
from snowsplat.pipeline.options.make import PRESETS
from snowsplat.project.left_out import LeftOut
from snowsplat.sfm.colmap.options import thread_count
from snowsplat.sfm.cost import measure_speed, predicted_seconds, survey
from snowsplat.sfm.ingest.photos.photo_files import Header, Unusable, read_header
from snowsplat.sfm.ingest.search.archive import files_in
from snowsplat.sfm.ingest.search.sources import Source, Sources
from snowsplat.sfm.ingest.video.clip import max_frame_count, read_clip
from snowsplat.util.duration import duration
from snowsplat.util.errors import UserError
from snowsplat.util.files import shown
from snowsplat.util.messages import Message, message

# So many files that are not used are named; the others are counted.
_NAMED = 5


def describe_photos(sources: Sources) -> dict[str, Any]:
    """The properties of the photos and videos in a file or folder, as a JSON object.

    Reads headers, and decodes up to 16 masks: the frames of videos and the pixels of photos are not
    decoded, unless two photos may be copies.
    Raises: UserError: a video is not readable.
    """
    path = sources.inputs[0]
    usable, left_out = [], list(sources.left_out)
    for source in sources.photos:
        try:
            usable.append(read_header(source.path))
        except Unusable as error:
            left_out.append(LeftOut(shown(source.path), "photos", error.message))
    if not (usable or sources.videos):
        raise UserError(
            "{path}: none of its {count} photos can be used ({name} {why})",
            path=path,
            count=len(sources.photos),
            name=left_out[-1].photo,
            why=left_out[-1].reason,
        )
    photos = survey(sources)
    speed = measure_speed(thread_count(None))
    time = duration(predicted_seconds(photos, PRESETS["normal"].photos, "normal", speed))
    doubt = doubt_about_files([s.mask for s in sources.photos if s.mask is not None])
    poses = message("none; to estimate them takes about {time}", time=time)
    if (unread := advice(path)) is not None:
        poses = message("{poses}; {unread}", poses=poses, unread=unread)
    return {
        "kind": "photos" if usable else "video",
        "path": str(path),
        **(_of_photos(usable, sources.photos) if sources.photos else {}),
        **({"videos": _of_videos(sources.videos)} if sources.videos else {}),
        **_first([(each.photo, each.reason) for each in left_out], "not_used"),
        **_first(
            [(shown(p), message("has no photo")) for p in sources.unused_masks], "unused_masks"
        ),
        **({} if doubt is None else {"doubtful": doubt}),
        "camera_poses": poses,
        "next": f"snowsplat make {path}",
    }


def describe_zip(path: Path) -> dict[str, Any]:
    """What a zip file contains; it is not unpacked.

    Raises: UserError: see `snowsplat.sfm.ingest.search.archive.unpack`.
    """
    suffixes = [PurePosixPath(name).suffix.lower() for name in files_in(path)]
    return {
        "kind": "zip file",
        "path": str(path),
        "photos": sum(suffix in PHOTO_SUFFIXES for suffix in suffixes),
        "videos": sum(suffix in VIDEO_SUFFIXES for suffix in suffixes),
        "files": len(suffixes),
        "next": message(
            "snowsplat make {path}, which unpacks it into a folder beside it", path=path
        ),
    }


def _of_photos(headers: Sequence[Header], sources: Sequence[Source]) -> dict[str, Any]:
    sizes = Counter("x".join(map(str, header.size(None))) for header in headers)
    exif = [header.exif for header in headers]
    return {
        "photos": len(headers),
        "formats": _counts(header.format for header in headers),
        "sizes": dict(sizes.most_common(_NAMED)),
        "cameras": _counts(info.camera or "unknown" for info in exif),
        "with_focal_length": sum(info.focal is not None for info in exif),
        "with_gps": sum(info.location is not None for info in exif),
        "with_attitude": sum(info.attitude is not None for info in exif),
        "with_transparency": sum(header.transparent for header in headers),
        "masks": sum(source.mask is not None for source in sources),
    }


def _counts(names: Any) -> dict[str, int]:
    return dict(Counter(names).most_common(_NAMED))


def _of_videos(sources: Sequence[Source]) -> dict[str, Message]:
    described = {}
    for source in sources:
        clip = read_clip(source.path)
        used = max_frame_count(clip, None, None)
        described[shown(source.path)] = message(
            "{width}x{height}, {time}, {used} of {frames} frames will be used",
            width=clip.width,
            height=clip.height,
            time=duration(clip.seconds),
            used=used,
            frames=clip.packets,
        )
    return described


def _first(reasons: Sequence[tuple[str, Message]], key: str) -> dict[str, Any]:
    """An entry for the first files and the number of all; none if there are no files."""
    if not reasons:
        return {}
    named: dict[str, Any] = dict(reasons[:_NAMED])
    if len(reasons) > _NAMED:
        named["and"] = message("{n} more", n=len(reasons) - _NAMED)
    return {key: named}
