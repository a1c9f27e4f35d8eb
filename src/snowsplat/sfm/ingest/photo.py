"""A photo of a dataset, and its name in ``input/``: unique, and not too long."""

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from snowsplat.project.left_out import LeftOut
from snowsplat.util.files import shown
from snowsplat.util.messages import Message

_LONGEST_NAME = 200  # bytes of a name in input/
_KEPT_END = 12  # characters at the end of a longer name


def folded_stem(name: str) -> str:
    """The name of a file without its suffix, and without a difference of case."""
    return str(PurePosixPath(name).with_suffix("")).casefold()


def _shorten(part: str) -> str:
    """A name of at most 200 bytes, so that ".NAME.png.tmp" fits into the 255 of a file system."""
    if len(part.encode()) <= _LONGEST_NAME:
        return part
    path = PurePosixPath(part)
    end = path.stem[-_KEPT_END:] + path.suffix  # with the number of the photo
    room = max(0, _LONGEST_NAME - len(end.encode()))
    return path.stem.encode()[:room].decode(errors="ignore") + end


def free_name(name: str, taken: set[str]) -> str:
    """``name``, or a variant of it that is not in ``taken`` except for case, and not too long.

    "a.jpg" becomes "a_2.jpg", "a_3.jpg" and so on. The result is added to ``taken``.
    """
    name = "/".join(_shorten(part) for part in shown(name).split("/"))
    path = PurePosixPath(name)
    candidate, n = name, 1
    while candidate.casefold() in taken:
        n += 1
        candidate = str(path.with_name(f"{path.stem}_{n}{path.suffix}"))
    taken.add(candidate.casefold())
    return candidate


Direction = tuple[float, float, float]


@dataclass(frozen=True)
class Attitude:
    """How the camera was held, as its sensors measured it.

    Directions are unit vectors in the frame of the upright photo: x right, y down, z forward.
    """

    up: Direction | None  # against gravity
    north: Direction | None  # true north, from the yaw of a gimbal or from a compass
    gimbal: bool  # a gimbal of a drone; False: the accelerometer and the compass of a phone


@dataclass(frozen=True)
class Photo:
    """A photo in ``input/``, upright unless ``turned``, and its metadata.

    All fields can be stored as JSON.
    """

    name: str  # path relative to input/, with "/"; unique
    source: str  # the original, as text for users: a path, or "walk.mp4 at 3.2 s"
    width: int  # pixels, as stored in input/
    height: int
    group: str = ""  # photos of a group have the same camera and zoom, so they share intrinsics
    sequence: str | None = None  # video of a frame; its frames sorted by name are in time order
    focal: float | None = None  # pixels, from EXIF; None if unknown
    location: tuple[float, float, float] | None = None  # GPS: latitude, longitude (°), altitude (m)
    mask: bool = False  # whether distorted/masks/NAME.png exists
    alpha: bool = False  # whether the photo has transparent pixels
    location_error: float | None = None  # m, horizontal, as the receiver states it
    attitude: Attitude | None = None
    panorama: bool = False  # equirectangular, of all directions
    turned: int = 1  # EXIF orientation if the pixels in input/ are not upright
    circle: float | None = None  # radius in pixels, if the picture is a disc, as of a fisheye lens


def not_used(path: Path, reason: Message) -> LeftOut:
    """A photo, video or folder that is not used. ``reason`` continues its name."""
    return LeftOut(shown(path), "photos", reason)
