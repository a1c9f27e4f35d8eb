"""`snowsplat render`: images of a scene from the cameras of its photos, and videos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from snowsplat.cli.flags import flag, switch
from snowsplat.cli.next_steps import next_step, see_and_share
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.reports import JsonFlag, Reports
from snowsplat.cli.scene_flags import SceneFlags
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message

if TYPE_CHECKING:
    from snowsplat.pipeline.evaluate import Split


@dataclass
class Render(SceneFlags, Reports):
    """Render images at the camera poses of the photos, or a video.

    Examples:
      snowsplat render out/garden
      snowsplat render out/garden --split test --depth color
      snowsplat render out/garden --path ellipse
      snowsplat render out/garden --path training --seconds 20 --size 1920x1080
      snowsplat render out/garden --path keys.json --side-by-side
      snowsplat render garden.ply --path ellipse --video garden.mp4
      snowsplat render out/garden --path training --projection equirectangular

    Notes:
      Images are written to OUT/test/ours_N/renders (for held-out photos) and
      OUT/train/ours_N/renders (for training photos) as 00000.png …, in the order
      of the names of the photos. N is the number of steps. Copies of the photos
      are written to the folder gt next to renders. Videos are written to
      OUT/videos.
      For a video along an ellipse or through the cameras of a file, a scene file
      in place of OUT is sufficient.
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
    """Also write the depth, to depth/00000.png … 16bit: grey values, whose unit is written to
    world_units_per_step.json; color: colours from yellow (near) to violet (far). With --path, color
    writes a second video."""

    antialias: Annotated[Literal["on", "off"] | None, flag("{on,off}", default="as trained")] = None
    """Whether to render for the size of the pixels, as scenes trained with --antialias on are
    rendered. Use it if a scene file from another program lacks this mark."""

    projection: Annotated[
        Literal["pinhole", "equirectangular"], flag("{pinhole,equirectangular}", default="pinhole")
    ] = "pinhole"
    """equirectangular: 360° pictures of all directions, level, from the places of the photos or
    along --path: images to OUT/SPLIT/ours_N/panoramas, or a 360° video; --size is their width."""

    path: Annotated[str | None, flag("{training,ellipse,spiral,FILE}", default="render images")] = (
        None
    )
    """Render a video along this camera path. training: a smooth curve along the cameras of the
    photos; ellipse: around the point that these cameras look at; spiral: for scenes whose cameras
    look in one direction; FILE: a smooth curve through the cameras in a file with the format of
    OUT/cameras.json, as a loop if the first and the last camera are equal; a camera may have a
    "speed" relative to the others, 0.5 for half of it."""
    seconds: Annotated[float | None, flag("F", default="10")] = None
    """Length of the video in seconds."""
    fps: Annotated[float | None, flag("F", default="30")] = None
    """Frames per second of the video."""
    ease: Annotated[bool, switch()] = False
    """Begin and end slowly; for a path through the cameras of a file."""
    size: Annotated[str | None, flag("WxH|W", default="that of the photos")] = None
    """Width and height of the video in pixels, or only its width."""
    side_by_side: Annotated[bool, switch()] = False
    """Write one video with colour on the left and depth on the right."""
    video: Annotated[Path | None, flag("FILE.mp4", "--film", default="in OUT/videos")] = None
    """File to which the video is written."""
    json: JsonFlag = False

    def run(self) -> int:
        if self.path is not None:
            self._render_video(self.path)
            return 0
        around = self.projection == "equirectangular"
        for name in ("seconds", "fps", "ease", "size", "side_by_side", "video"):
            if getattr(self, name) and not (around and name == "size"):
                raise UserError("`{name}` is for videos; add a camera path with --path", name=name)
        splits: list[Split] = []
        if self.split != "train" and not self.skip_test:
            splits.append("test")
        if self.split != "test" and not self.skip_train:
            splits.append("train")
        from snowsplat.pipeline.render import render_images, render_panoramas

        if around:
            if self.depth != "none":
                raise UserError("--projection equirectangular has no depth; leave out --depth")
            rendered = render_panoramas(
                self.load(), splits=splits, size=self.size, antialias=self._antialias()
            )
        else:
            rendered = render_images(
                self.load(), splits=splits, depth=self.depth, antialias=self._antialias()
            )
        self.report = {"images": rendered}
        for folder, count in rendered.items():
            print(message("{folder}: {count} images", folder=folder, count=count))
        print(next_step("for a video", "render", self.output_path(), "--path", "ellipse"))
        return 0

    def _antialias(self) -> bool | None:
        return None if self.antialias is None else self.antialias == "on"

    def _render_video(self, path: str) -> None:
        if self.depth == "16bit":
            raise UserError("--depth 16bit is for images; a video takes --depth color")
        scene, target = self.output or self.model_path, self.video
        if target is None and self.model_path and self.model_path.suffix.lower() == ".mp4":
            scene, target = self.output, self.model_path  # -o FILE.mp4 can mean nothing else
        elif self.output is not None and self.model_path is not None:
            scene = None
        if scene is None:
            raise UserError("render needs one output folder of a training run, or one scene file")
        from snowsplat.pipeline.videos import VideoOptions, render_video

        options = VideoOptions(
            path=path,
            seconds=10.0 if self.seconds is None else self.seconds,
            fps=30.0 if self.fps is None else self.fps,
            size=self.size,
            depth=self.depth == "color",
            side_by_side=self.side_by_side,
            antialias=self._antialias(),
            projection=self.projection,
            ease=self.ease,
        )
        with TerminalObserver() as observer:
            videos = render_video(
                scene,
                options,
                target=target,
                iteration=self.iteration,
                compute=self.compute(),
                observer=observer,
            )
        self.report = {"videos": videos}
        print(see_and_share(scene))
