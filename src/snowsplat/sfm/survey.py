"""`survey`: counts the photos and the frames of videos, before they are read."""

from __future__ import annotations

import statistics
from contextlib import suppress
from dataclasses import dataclass

from snowsplat.sfm.ingest.photos.photo_files import Unusable, read_header
from snowsplat.sfm.ingest.search.sources import Sources
from snowsplat.sfm.ingest.video.clip import max_frame_count, read_clip
from snowsplat.sfm.options import GatherOptions

#: The sizes of about this number of photos are read.
_HEADERS = 10


@dataclass(frozen=True)
class Photos:
    """The properties of the input that determine the time of structure from motion.

    Attributes:
        stills: number of photos.
        frames: number of used frames of all videos.
        longest: the longer side of an original photo, in pixels (median).
        videos: number of videos.
        decoded: number of frames of all videos. All of them are decoded, to choose the used ones.
        video: the longer side of the frames, in pixels (maximum of all videos).
    """

    stills: int
    frames: int = 0
    longest: int = 0
    videos: int = 0
    decoded: int = 0
    video: int = 0

    @property
    def count(self) -> int:
        """Number of photos and used frames."""
        return self.stills + self.frames


def survey(sources: Sources, options: GatherOptions | None = None) -> Photos:
    """The photos and frames that `gather` will use, if none of them is unusable.

    Raises: UserError: a video is not readable.
    """
    options = options or GatherOptions()
    photos = [source.path for source in sources.photos]
    clips = [read_clip(source.path) for source in sources.videos]
    longest = []
    for path in photos[:: max(1, len(photos) // _HEADERS)]:
        with suppress(Unusable):
            header = read_header(path)
            longest.append(max(header.width, header.height))
    return Photos(
        stills=min(len(photos), options.photos or len(photos)),
        frames=sum(max_frame_count(clip, options.fps, options.frames) for clip in clips),
        longest=round(statistics.median(longest)) if longest else 0,
        videos=len(clips),
        decoded=sum(clip.packets for clip in clips),
        video=max((max(clip.width, clip.height) for clip in clips), default=0),
    )
