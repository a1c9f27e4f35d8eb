"""`PageFilm`: a film that was planned in a page: its key cameras, length and size.

It imports no torch.
"""

import math
from dataclasses import dataclass

from snowsplat.project.edit_record import is_view
from snowsplat.util.errors import Problem

#: Width and height of the films, in pixels.
SIZES = ("1920x1080", "1080x1920", "1080x1080")
_MOST_KEYS = 200
_LONGEST = 600.0  # seconds
_SLOWEST, _FASTEST = 0.1, 10.0


@dataclass(frozen=True)
class PageFilm:
    """A film that was planned in a page.

    Attributes:
        keys: at least two views in the frame of the page, in their order: position, target, field
            of view in degrees, aspect; see `InitialView`.
        seconds: its length.
        size: one of `SIZES`.
        ease: slow at the start and at the end.
        loop: from the last key back to the first one; it needs at least three keys.
        speeds: of the camera at each key, relative to each other; see `trajectory.key_path`. Empty:
            all are equal.

    Raises: ValueError: a value is not possible.
    """

    keys: list[list[float]]
    seconds: float = 10.0
    size: str = SIZES[0]
    ease: bool = False
    loop: bool = False
    speeds: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        least = 3 if self.loop else 2
        if not least <= len(self.keys) <= _MOST_KEYS:
            raise Problem(
                "a film needs {least} to {most_keys} keys", least=least, most_keys=_MOST_KEYS
            )
        if not all(is_view(key) and all(map(math.isfinite, key)) for key in self.keys):
            raise Problem("a key is no view")
        if self.speeds and len(self.speeds) != len(self.keys):
            raise Problem(
                "{speeds} speeds are not those of {keys} keys",
                speeds=len(self.speeds),
                keys=len(self.keys),
            )
        if not all(_SLOWEST <= speed <= _FASTEST for speed in self.speeds):
            raise Problem(
                "the speeds are from {slowest:g} to {fastest:g}", slowest=_SLOWEST, fastest=_FASTEST
            )
        if not 0 < self.seconds <= _LONGEST:
            raise Problem("a film has at most {longest:g} seconds", longest=_LONGEST)
        if self.size not in SIZES:
            raise Problem("the sizes are {sizes}", sizes=", ".join(SIZES))

    def pixels(self) -> tuple[int, int]:
        """Width and height."""
        width, height = self.size.split("x")
        return int(width), int(height)
