"""`snowsplat render`: images of a scene from the cameras of its photos, and videos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from snowsplat.cli.flags import flag, switch
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.scene_flags import SceneFlags
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    from snowsplat.pipeline.evaluate import Split


@dataclass
class Render(SceneFlags):
    """Render a scene from the camera poses of its photos, or along a path as a video.

    Examples:
      snowsplat render out/garden
      snowsplat render out/garden --split test --depth color
      snowsplat render out/garden --path ellipse
      snowsplat render out/garden --path training --seconds 20 --size 1920x1080
      snowsplat render out/garden --path keys.json --side-by-side
      snowsplat render garden.ply --path ellipse --video garden.mp4

    The images are written to OUT/test/ours_N/renders (held-out photos) and OUT/train/ours_N/renders
    as 00000.png … in the order of the names of the photos; copies of the photos to gt/ beside it.
    Videos are written to OUT/videos. A video along an ellipse or through a list of cameras needs
    only a scene file.
    """

    split: Annotated[Literal["all", "test", "train"], flag("{all,test,train}", default="all")] = (
        "all"
    )
    """test: the held-out photos; train: the training photos; all: both."""
    skip_train: Annotated[bool, switch()] = False
    """The same as --split test."""
    skip_test: Annotated[bool, switch()] = False
    """The same as --split train."""
    depth: Annotated[
        Literal["none", "16bit", "color"], flag("{none,16bit,color}", default="none")
    ] = "none"
    """Also write the depth, to depth/00000.png …: as 16-bit gray values, whose unit is in
    world_units_per_step.json, or in colors from near (yellow) to far (violet). With --path, color
    renders a second video."""

    path: Annotated[str | None, flag("{training,ellipse,spiral,FILE}", default="images")] = None
    """Render a video along this camera path. training: along the cameras of the photos, smoothed;
    ellipse: around what they show; spiral: in front of a scene whose cameras look in one direction;
    FILE: through the cameras of a file like OUT/cameras.json, a loop if its first and last camera
    are equal."""
    seconds: Annotated[float | None, flag("F", default="10")] = None
    """Length of the video."""
    fps: Annotated[float | None, flag("F", default="30")] = None
    """Frames per second."""
    size: Annotated[str | None, flag("WxH|W", default="that of the photos")] = None
    """Size of the video in pixels, or its width."""
    side_by_side: Annotated[bool, switch()] = False
    """One video with color on the left and depth on the right."""
    video: Annotated[Path | None, flag("FILE.mp4", "--film", default="in OUT/videos")] = None
    """File of the video."""

    def run(self) -> int:
        """Returns the exit code, 0."""
        if self.path is not None:
            self._render_video(self.path)
            return 0
        for name in ("seconds", "fps", "size", "side_by_side", "video"):
            if getattr(self, name):
                raise UserError(f"`{name}` is for videos; add a camera path with --path")
        splits: list[Split] = []
        if self.split != "train" and not self.skip_test:
            splits.append("test")
        if self.split != "test" and not self.skip_train:
            splits.append("train")
        from snowsplat.pipeline.render import render_images

        for folder, count in render_images(self.load(), splits=splits, depth=self.depth).items():
            print(f"{folder}: {count} images")
        return 0

    def _render_video(self, path: str) -> None:
        from snowsplat.pipeline.videos import VideoOptions, render_video

        if self.depth == "16bit":
            raise UserError("--depth 16bit is for images; a video takes --depth color")
        scene, target = self.output or self.model_path, self.video
        if target is None and self.model_path and self.model_path.suffix.lower() == ".mp4":
            scene, target = self.output, self.model_path  # -o FILE.mp4 can mean nothing else
        elif self.output is not None and self.model_path is not None:
            scene = None
        if scene is None:
            raise UserError("render needs one output folder of a training, or one scene file")
        options = VideoOptions(
            path=path,
            seconds=10.0 if self.seconds is None else self.seconds,
            fps=30.0 if self.fps is None else self.fps,
            size=self.size,
            depth=self.depth == "color",
            side_by_side=self.side_by_side,
        )
        with TerminalObserver() as observer:
            render_video(
                *(scene, options),
                target=target,
                iteration=self.iteration,
                compute=self.compute(),
                observer=observer,
            )
