"""`DatasetOptions`: what one can set of structure from motion. This module imports nothing slow."""

from dataclasses import dataclass
from typing import Literal

from snowsplat.scene.length import metres_of
from snowsplat.util.settings import Settings, flag, group, setting, switch

Mapper = Literal["incremental", "global"]
EffortName = Literal["draft", "normal", "best"]

#: Two photos tell no scale of a third one: with fewer photos, there is no scene.
MIN_PHOTOS = 3
_MIN_SIZE = 128  # pixels


@dataclass(frozen=True)
class GatherOptions(Settings):
    """Photos, frames and sizes to use. At most one of ``fps`` and ``frames`` may be set.

    Attributes:
        photos: maximum number of photos, evenly spread in the order of their names; None: all.
        panoramas: all photos and videos show all directions; False: if they say so.
        as_stored: photos in place keep their pixels as stored, because a model of these exists.
    """

    fps: float | None = flag(
        None,
        "Number of frames to use per second of video.",
        "2.5; lower for long videos",
        above=0.0,
        allowed="a number above 0, e.g. 2",
    )
    frames: int | None = flag(
        None,
        "Number of frames to use per video.",
        "determined by --fps",
        least=MIN_PHOTOS,
        allowed=f"{MIN_PHOTOS} or more, e.g. 60",
    )
    size: int | None = setting(
        None,
        "Scale photos and frames down so that their longer side has this many pixels.",
        "unchanged",
        least=_MIN_SIZE,
        allowed=f"{_MIN_SIZE} or more",
        metavar="PIXELS",
    )
    photos: int | None = setting(None, "Maximum number of photos.", least=1, allowed="1 or more")
    panoramas: bool = False
    as_stored: bool = False


@dataclass(frozen=True)
class SfmOptions(Settings):
    """Options of the pose estimation.

    Attributes:
        camera_model: one of `CAMERA_MODELS`, or "auto": OPENCV if enough photos share a camera to
            determine its eight parameters, else SIMPLE_RADIAL; of a fisheye lens, OPENCV_FISHEYE or
            SIMPLE_RADIAL_FISHEYE. Panoramas (`Photo.panorama`) have their own model.
        seconds: if this time is set, no further attempt begins that would probably end later. There
            is always a first attempt, and further ones until poses are found.
    """

    effort: EffortName = flag(
        "normal",
        "Effort to detect and match features. best takes several times as long as normal.",
        name="quality",
    )
    camera_model: str = setting(
        "auto",
        "Camera model, by its name in COLMAP: SIMPLE_RADIAL, OPENCV, OPENCV_FISHEYE, PINHOLE …; "
        "EQUIRECTANGULAR: 360° panoramas whose files do not say so.",
        "",
        parse=lambda name: name if name == "auto" else name.upper(),
        metavar="MODEL",
        aliases=("--camera",),
    )
    mapper: Mapper = flag(
        "incremental",
        "incremental: estimate the camera poses one after the other; global: estimate all poses at "
        "once, which is faster for many photos.",
    )
    threads: int | None = flag(None, "Number of CPU threads.", "all cores", least=1)
    seconds: float | None = None


@dataclass(frozen=True)
class DatasetOptions(Settings):
    """Options for making a dataset from photos.

    Attributes:
        marker: in metres; None: there are none.
    """

    gather: GatherOptions = group(GatherOptions)
    resize: bool = switch(
        "Also write the photos at 1/2, 1/4 and 1/8 of their width and height, to images_2, "
        "images_4 and images_8."
    )
    sfm: SfmOptions = group(SfmOptions)
    skip_matching: bool = switch(
        "With -s, do not estimate camera poses; use the COLMAP model in "
        "LOCATION/distorted/sparse/0 and only undistort the photos."
    )
    marker: float | None = setting(
        None,
        "Side of the black square of ArUco or AprilTag markers that lie in the scene, e.g. 0.10m, "
        "10cm, 4in: one unit of the scene is then one metre. Markers that lie flat also tell up.",
        "none",
        above=0.0,
        parse=metres_of,
        metavar="LENGTH",
    )
