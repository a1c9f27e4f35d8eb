"""`GlobeOptions`: what one can set of a snow globe. This module imports nothing slow."""

from dataclasses import dataclass

from snowsplat.pipeline.options.video import VideoSize
from snowsplat.util.settings import Settings, flag, setting

_LARGEST = 1_000_000  # Gaussians: the page has 26 bytes for each
LONGEST_NAME = 60
_SIDE = 960  # pixels of a video


def _long(name: str) -> str | None:
    length = len(name)
    problem = f"has {length} letters, which are too many; use at most {LONGEST_NAME}"
    return problem if length > LONGEST_NAME else None


@dataclass(frozen=True)
class GlobeOptions(Settings):
    """Options of a globe. Raises: UserError: a value is out of range."""

    gaussians: int = flag(
        100_000,
        "Maximum number of Gaussians. The most important ones are used.",
        least=1,
        most=_LARGEST,
        allowed=f"1 to {_LARGEST:,}",
        aliases=("-n",),
    )
    name: str | None = flag(
        None, "Text on the plate of the base.", "the name of the scene", check=_long
    )
    size: str | None = setting(
        None,
        "Width and height of the video in pixels, or the side of a square.",
        "960x960",
        metavar="WxH|W",
    )
    fps: float = flag(
        30.0, "Frames per second of the video.", least=1.0, most=120.0, allowed="1 to 120"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        VideoSize.parse(self.size)

    @property
    def video_size(self) -> tuple[int, int]:
        """Width and height of the video in pixels, both even."""
        size = VideoSize.parse(self.size)
        width = size.width or _SIDE
        return 2 * (width // 2), 2 * ((size.height or width) // 2)
