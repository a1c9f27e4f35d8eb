"""`VideoOptions`: what one can set of a video."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from snowsplat.util.errors import SettingError
from snowsplat.util.settings import Settings, flag, setting, switch

if TYPE_CHECKING:
    from snowsplat.scene.camera import Camera

Projection = Literal["pinhole", "equirectangular"]

#: The camera paths that are computed from the cameras of a training run.
CAMERA_PATHS = ("training", "ellipse", "spiral")

_LONGEST_SIDE = 1920  # of a video without a requested size
_SMALLEST, _LARGEST = 16, 8192  # pixels along a side
_MAX_FRAMES = 100_000
_PANORAMA_WIDTH = 3840  # of a 360° picture without a requested size


@dataclass(frozen=True)
class VideoSize:
    """The requested size of a video, in pixels; None if a side was not requested."""

    width: int | None = None
    height: int | None = None

    @classmethod
    def parse(cls, text: str | None) -> VideoSize:
        """Parse "1280x720", "1280" or None. Raises: UserError: ``text`` is no possible size."""
        if text is None:
            return cls()
        match = re.fullmatch(r"(\d{1,6})(?:[xX×](\d{1,6}))?", text)
        if match is None:
            raise SettingError(
                "size", "{text!r} is not a size; use e.g. 1280x720, or a width, 1280", text=text
            )
        width, height = int(match[1]), int(match[2]) if match[2] else None
        if not all(_SMALLEST <= side <= _LARGEST for side in (width, height) if side is not None):
            raise SettingError(
                "size",
                "{text} is out of range; use {smallest} to {largest} pixels",
                text=text,
                smallest=_SMALLEST,
                largest=_LARGEST,
            )
        return cls(width, height)

    def for_camera(self, camera: Camera) -> tuple[int, int]:
        """Width and height, both even; a side that was not requested is taken from ``camera``."""
        width, height = camera.width, camera.height
        if self.width is None:
            scale = min(1.0, _LONGEST_SIDE / max(width, height))
        else:
            scale = self.width / width
        wanted = (self.width or width * scale, self.height or height * scale)
        # Cameras may come from files. A very narrow one would be extremely high at a large width.
        width, height = (min(_LARGEST, max(_SMALLEST, 2 * int(side / 2 + 0.25))) for side in wanted)
        return width, height


def panorama_width(size: str | None) -> int:
    """The width of a panorama of the requested size, in pixels. Raises UserError."""
    wanted = VideoSize.parse(size)
    width = wanted.width or _PANORAMA_WIDTH
    if width % 4 or wanted.height not in (None, width // 2):
        raise SettingError(
            "size",
            "{size} is no size of a 360° picture, which is twice as wide as high with a width "
            "that is a multiple of 4; use e.g. 3840",
            size=size,
        )
    return width


@dataclass(frozen=True)
class VideoOptions(Settings):
    """Options of a video: camera path, length, size, depth.

    Attributes:
        depth: render a second video that shows the depth in colours.
        antialias: None: as trained.

    Raises:
        UserError: an unusable length, rate or size.
    """

    antialias: bool | None = flag(
        None,
        "Whether to render for the size of the pixels, as scenes trained with --antialias on are "
        "rendered. Use it if a scene file from another program lacks this mark.",
        "as trained",
    )
    projection: Projection = flag(
        "pinhole",
        "equirectangular: 360° pictures of all directions, level, from the places of the photos or "
        "along --path: images to OUT/SPLIT/ours_N/panoramas, or a 360° video; --size is their "
        "width.",
    )
    path: str = setting(
        "ellipse",
        "Render a video along this camera path. training: a smooth curve along the cameras of the "
        "photos; ellipse: around the point that these cameras look at; spiral: for scenes whose "
        "cameras look in one direction; FILE: a smooth curve through the cameras in a file with "
        "the format of OUT/cameras.json, as a loop if the first and the last camera are equal; a "
        'camera may have a "speed" relative to the others, 0.5 for half of it.',
        "render images",
        metavar="{training,ellipse,spiral,FILE}",
    )
    seconds: float = flag(10.0, "Length of the video in seconds.", above=0.0)
    fps: float = flag(30.0, "Frames per second of the video.", above=0.0)
    ease: bool = switch("Begin and end slowly; for a path through the cameras of a file.")
    size: str | None = setting(
        None,
        "Width and height of the video in pixels, or only its width.",
        "that of the photos",
        metavar="WxH|W",
    )
    side_by_side: bool = switch("Write one video with colour on the left and depth on the right.")
    depth: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.seconds * self.fps > _MAX_FRAMES:
            raise SettingError(
                "seconds",
                "{seconds:g} with `fps` {fps:g} is more than {max_frames:,} frames; make the "
                "video shorter",
                seconds=self.seconds,
                fps=self.fps,
                max_frames=_MAX_FRAMES,
            )
        if self.ease and self.path in CAMERA_PATHS:
            raise SettingError("ease", "is for a path through the cameras of a file; leave it out")
        if self.projection == "equirectangular":
            if self.depth or self.side_by_side:
                raise SettingError("projection", "equirectangular has no depth; render it alone")
            panorama_width(self.size)
        VideoSize.parse(self.size)

    @property
    def frames(self) -> int:
        """The number of frames."""
        return max(1, round(self.seconds * self.fps))

    @property
    def name(self) -> str:
        """The name of the file, without its suffix."""
        name = self.path if Path(self.path).suffix == "" else Path(self.path).stem
        around = self.projection == "equirectangular"
        return name + "_side_by_side" * self.side_by_side + "_360" * around
