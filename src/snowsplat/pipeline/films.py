"""Films of a scene: where the camera goes, at which size, and the work of `render --path`."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    import numpy as np

    from snowsplat.scene.camera import Camera
    from snowsplat.scene.gaussians import Gaussians

#: The ways that are made from the cameras of a training.
WAYS = ("training", "ellipse", "spiral")

_LONGEST_SIDE = 1920  # of a film whose size is not named
_SMALLEST, _LARGEST = 16, 8192  # pixels along a side
_MOST_FRAMES = 100_000
_RANGE_FRAMES = 8  # that decide which depths get which colours


@dataclass(frozen=True)
class FilmSize:
    """What --size says.

    Attributes:
        width, height: pixels; None where it is not said.
    """

    width: int | None = None
    height: int | None = None

    @classmethod
    def parse(cls, text: str | None) -> FilmSize:
        """Of "1280x720", "1280" or nothing.

        Raises:
            UserError: anything else, or too small or large.
        """
        if text is None:
            return cls()
        match = re.fullmatch(r"(\d{1,6})(?:[xX×](\d{1,6}))?", text)
        if match is None:
            raise UserError(f"--size is {text!r}; it must be like 1280x720, or a width like 1280")
        width, height = int(match[1]), int(match[2]) if match[2] else None
        if not all(_SMALLEST <= side <= _LARGEST for side in (width, height) if side is not None):
            raise UserError(f"--size is {text}; sides must be {_SMALLEST} to {_LARGEST} pixels")
        return cls(width, height)

    def of(self, camera: Camera) -> tuple[int, int]:
        """Width and height, both even; those of ``camera`` as far as nothing else was said."""
        width, height = camera.width, camera.height
        if self.width is None:
            scale = min(1.0, _LONGEST_SIDE / max(width, height))
        else:
            scale = self.width / width
        wanted = (self.width or width * scale, self.height or height * scale)
        # Cameras are taken from files too: a narrow one, made wide, is as high as a tower.
        width, height = (min(_LARGEST, max(_SMALLEST, 2 * int(side / 2 + 0.25))) for side in wanted)
        return width, height


def frames_in(seconds: float, fps: float) -> int:
    """How many.

    Raises:
        UserError: none, or far too many.
    """
    for flag, value in (("--seconds", seconds), ("--fps", fps)):
        if not 0 < value < float("inf"):
            raise UserError(f"{flag} is {value:g}; it must be more than 0")
    if seconds * fps > _MOST_FRAMES:
        raise UserError(
            f"--seconds {seconds:g} with --fps {fps:g} is a film of more than {_MOST_FRAMES:,} "
            "frames; make it shorter"
        )
    return max(1, round(seconds * fps))


def cameras_along(
    way: str,
    gaussians: Gaussians,
    trained: tuple[list[str], list[Camera]] | None,
    frames: int,
    size: FilmSize,
) -> list[Camera]:
    """One camera a frame.

    Args:
        way: one of `WAYS`, or a file of key cameras.
        trained: names and cameras of the photos; None for a scene of which only the file is there.

    Raises:
        UserError: no such way or file, or one that needs the cameras of a training.
    """
    from snowsplat import trajectory as paths
    from snowsplat.scene.camera_json import read_cameras

    if way not in WAYS:
        if Path(way).suffix.lower() != ".json":
            known = ", ".join(WAYS)
            raise UserError(f"--path is {way}; it must be {known} or a file of cameras (.json)")
        _, keys = read_cameras(Path(way))
        distance = paths.viewing_distance(keys, gaussians.means)
        cameras = paths.key_path(keys, frames, distance)
    elif trained is not None:
        names, given = trained
        distance = paths.viewing_distance(given, gaussians.means)
        if way == "training":
            cameras = paths.training_path(given, names, frames, distance)
        else:
            make = paths.ellipse_path if way == "ellipse" else paths.spiral_path
            cameras = make(given, frames, distance)
    elif way == "ellipse":
        width, height = size.width or 1280, size.height or (size.width or 1280) * 9 // 16
        cameras = paths.orbit_path(gaussians.means, gaussians.opacities, frames, width, height)
    else:
        raise UserError(
            f"--path {way} needs the cameras of a training; name its output folder, or take "
            "--path ellipse or a file of cameras"
        )
    width, height = size.of(cameras[0])
    return [paths.resized(camera, width, height) for camera in cameras]


@dataclass(frozen=True)
class Film:
    """A film to be made.

    Attributes:
        cameras: one a frame, all of one even size.
        file: of the film in colour; that of depth has _depth in its name.
        depth: make a film of depth, too.
        side_by_side: both in one film, colour to the left, instead.
    """

    gaussians: Gaussians
    cameras: Sequence[Camera]
    background: tuple[float, float, float]
    file: Path
    fps: float
    depth: bool
    side_by_side: bool

    def make(self) -> None:
        """Render and write it, telling how far it is.

        Raises:
            UserError: it cannot be written.
            KeyboardInterrupt: Ctrl-C; then nothing is there.
        """
        import torch

        from snowsplat.cli.stages import StageProgress
        from snowsplat.trajectory.video import film
        from snowsplat.util.files import remove_temporaries

        first = self.cameras[0]
        width, height = first.width, first.height
        pictures = self._files()
        with torch.no_grad(), StageProgress() as progress:
            started = time.monotonic()
            report = progress.begin("film")
            self.file.parent.mkdir(parents=True, exist_ok=True)
            remove_temporaries(self.file.parent, [file.name for file, _ in pictures])
            near, far = self._depth_range()
            with ExitStack() as stack:
                adds = [
                    stack.enter_context(film(file, factor * width, height, self.fps))
                    for file, factor in pictures
                ]
                for i, camera in enumerate(self.cameras):
                    for add, pixels in zip(adds, self._frame(camera, near, far), strict=True):
                        add(pixels)
                    report(i + 1, len(self.cameras), "frames")
            files = " and ".join(str(file) for file, _ in pictures)
            size = f"{pictures[0][1] * width}x{height}"
            line = f"{files}: {len(self.cameras)} frames {size}"
            progress.end(line, time.monotonic() - started)

    def _files(self) -> list[tuple[Path, int]]:
        """Each film's name, and how many pictures are beside each other in it."""
        if self.side_by_side:
            return [(self.file, 2)]
        depth = self.file.with_name(f"{self.file.stem}_depth{self.file.suffix}")
        return [(self.file, 1), (depth, 1)] if self.depth else [(self.file, 1)]

    def _frame(self, camera: Camera, near: float, far: float) -> list[np.ndarray]:
        import numpy as np

        from snowsplat.pipeline import pictures

        color, depth = self._render(camera)
        if depth is None:
            return [color]
        shown = pictures.depth_in_color(depth, near, far)
        return [np.concatenate([color, shown], axis=1)] if self.side_by_side else [color, shown]

    def _depth_range(self) -> tuple[float, float]:
        """One range for the whole film, so that it does not flicker."""
        from snowsplat.pipeline import pictures

        if not (self.depth or self.side_by_side):
            return 1.0, 2.0
        some = self.cameras[:: -(-len(self.cameras) // _RANGE_FRAMES)]
        depths = [self._render(camera)[1] for camera in some]
        return pictures.depth_range([depth for depth in depths if depth is not None])

    def _render(self, camera: Camera) -> tuple[np.ndarray, np.ndarray | None]:
        import torch

        from snowsplat.pipeline import pictures
        from snowsplat.scene.render import render

        with_depth = self.depth or self.side_by_side
        background = torch.tensor(self.background)
        output = render(self.gaussians, camera, background, with_depth=with_depth)
        depth = None if output.depth is None else pictures.mean_depth(output.depth, output.alpha)
        return pictures.to_8bit(output.image), depth
