"""Whether the photos or the videos of a folder show the scene, if there are both.

Phones save a video of three seconds with every photo; cameras save a small photo with every video.
"""

from pathlib import Path

from snowsplat.project.left_out import LeftOut
from snowsplat.sfm.ingest.photo import folded_stem, not_used
from snowsplat.sfm.ingest.photos.photo_files import Unusable, read_header
from snowsplat.sfm.ingest.video.clip import film_size, why_no_video
from snowsplat.sfm.options import MIN_PHOTOS
from snowsplat.util.messages import Message, message


def photos_or_films(
    root: Path, photos: list[str], videos: list[str]
) -> tuple[list[str], list[str], list[LeftOut]]:
    """The photos of a folder, or its videos if there are fewer than three photos; and the others.

    A photo with the name of a video, and not larger than its frames, is the thumbnail of the video.
    Videos that cannot be read are left out if others can.
    """
    if not videos:
        return photos, [], []
    films = {folded_stem(video): video for video in videos}
    thumbnails: dict[str, Message] = {}
    others = 0
    for photo in photos:
        film = films.get(folded_stem(photo))
        if film is not None and _is_thumbnail(root / photo, root / film):
            thumbnails[photo] = message("is the thumbnail of {film}", film=film)
            continue
        others += 1
        if others == MIN_PHOTOS:
            reason = message(
                "is a video in a folder of photos; add it as an input to use its frames"
            )
            return photos, [], [not_used(root / video, reason) for video in videos]
    unreadable = {video: why for video in videos if (why := why_no_video(root / video))}
    readable = [video for video in videos if video not in unreadable]
    left_out = [not_used(root / video, why) for video, why in unreadable.items()]
    if not readable:
        # Without photos, reading the videos raises the error that says what is wrong.
        return (photos, [], left_out) if photos else ([], videos, [])
    few = message("is beside a video, and too few for a scene; the video is used")
    unused = [not_used(root / photo, thumbnails.get(photo, few)) for photo in photos]
    return [], readable, [*unused, *left_out]


def _is_thumbnail(photo: Path, video: Path) -> bool:
    frame = film_size(video)
    if frame is None:
        return False
    try:
        header = read_header(photo)
    except Unusable:  # for example an icon
        return True
    return header.width * header.height <= frame[0] * frame[1]
