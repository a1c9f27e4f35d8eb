"""`choose_plan`: how `make` keeps a time budget: quality, size and number of the photos.

Structure from motion must be finished after `_SHARE` of the time; training uses the rest.
`sfm.cost` predicts the time of structure from motion on this machine. The plan is the first of
these that is fast enough:

    all photos      at the size of "best", then at the size in which "best" detects features;
                    the same for "normal", then for "draft"
    fewer photos    for "draft", at the smaller size: as many as there is time for, but at least
                    `_FEWEST`. Photos are evenly spread in the order of their names; frames of a
                    video are selected as usual

At the smaller size of a quality, the poses are as accurate as at the larger one, and a short
training uses even smaller photos.

The prediction may be too low, because the number of features and the load of the machine change.
The training then has less time. If the prediction is too low by 45%, it still has a third.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from snowsplat.pipeline.quality import PRESETS, Quality
from snowsplat.util.duration import duration

if TYPE_CHECKING:
    from snowsplat.sfm.cost import Photos, Speed

#: The share of the time that everything before the training may take.
_SHARE = 0.45
#: With fewer photos, their distances may be too large for matches.
_FEWEST = 20
#: The size of this number of photos is read.
_HEADERS = 10


@dataclass(frozen=True)
class Found:
    """The inputs of `make`.

    Attributes:
        photos: all photos, and the frames that are used without a time budget.
        videos: number of videos.
    """

    photos: Photos
    videos: int = 0


@dataclass(frozen=True)
class MakePlan:
    """The work of structure from motion in `make`.

    Attributes:
        quality: its effort.
        size: photos are reduced to this longer side, in pixels.
        photos: number of photos to use; None: all.
        frames: number of frames to use of each video; None: as many as usual.
    """

    quality: Quality
    size: int
    photos: int | None = None
    frames: int | None = None


def choose_plan(
    seconds: float, found: Found, speed: Speed, quality: Quality | None = None
) -> MakePlan:
    """The best plan whose structure from motion takes at most `_SHARE` of ``seconds``.

    Args:
        found: all photos and frames that would be used without a time budget.
        quality: the requested quality; None: any.
    """
    from snowsplat.sfm.cost import predicted_seconds

    def fits(photos: Photos, quality: Quality, size: int) -> bool:
        return sum(predicted_seconds(photos, size, quality, speed).values()) <= _SHARE * seconds

    steps = list(_sizes(quality))
    for quality, size in steps:
        if fits(found.photos, quality, size):
            return MakePlan(quality, size)
    quality, size = steps[-1]
    every = found.photos
    count, fewest = every.count, min(_FEWEST, every.count)
    while count > fewest and not fits(_thinned(every, count), quality, size):
        count -= 1
    fewer = _thinned(every, count)
    return MakePlan(
        quality,
        size,
        photos=fewer.stills if fewer.stills < every.stills else None,
        frames=max(3, fewer.frames // found.videos) if fewer.frames < every.frames else None,
    )


def _sizes(quality: Quality | None) -> Iterator[tuple[Quality, int]]:
    """Qualities and sizes of the photos, in the order in which they are tried."""
    from snowsplat.sfm.colmap.options import EFFORTS

    every: tuple[Quality, ...] = ("best", "normal", "draft")
    for each in every if quality is None else (quality,):
        yield each, PRESETS[each].photos
        yield each, EFFORTS[each].image_size


def _thinned(photos: Photos, count: int) -> Photos:
    """``count`` of the photos and frames, with the same share of frames."""
    frames = round(count * photos.frames / photos.count)
    return replace(photos, stills=count - frames, frames=frames)


def find_photos(inputs: Sequence[Path]) -> Found:
    """Count the photos and frames in the inputs of `make`, and read their sizes.

    Raises:
        UserError: an input does not exist, or cannot be read.
    """
    from snowsplat.sfm.cost import Photos
    from snowsplat.sfm.ingest.clip import max_frame_count, read_clip
    from snowsplat.sfm.ingest.photo_files import Unusable, read_header
    from snowsplat.sfm.ingest.sources import find_sources

    sources = find_sources(inputs).sources
    photos = [source.path for source in sources if source.kind == "photo"]
    clips = [read_clip(source.path) for source in sources if source.kind == "video"]
    longest = []
    for path in photos[:: -(-len(photos) // _HEADERS) or 1]:
        with suppress(Unusable):
            header = read_header(path)
            longest.append(max(header.width, header.height))
    return Found(
        Photos(
            stills=len(photos),
            frames=sum(max_frame_count(clip, None, None) for clip in clips),
            longest=round(statistics.median(longest)) if longest else 0,
            decoded=sum(clip.packets for clip in clips),
            video=max((max(clip.width, clip.height) for clip in clips), default=0),
        ),
        len(clips),
    )


def described(plan: MakePlan, found: Found, seconds: float) -> str:
    """The plan in one line, such as "3 min 0 s: 60 of 300 photos, 1000 pixels, draft effort"."""
    photos = found.photos
    parts = []
    if photos.stills:
        few = "" if plan.photos is None else f"{plan.photos} of "
        parts.append(f"{few}{photos.stills} photos")
    if photos.frames:
        few = "" if plan.frames is None else f"{plan.frames * found.videos} of "
        parts.append(f"{few}{photos.frames} frames")
    size = min(plan.size, max(photos.longest, photos.video))
    what = " and ".join(parts)
    return f"{duration(seconds)}: {what}, {size} pixels, {plan.quality} effort"
