"""`snowsplat render`: images of a scene from the cameras of its photos, and videos."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from snowsplat.cli.command import JsonCommand, next_step, print_message, see_and_share
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.scene_choice import SceneChoice
from snowsplat.pipeline.options.video import VideoOptions
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message
from snowsplat.util.settings import flag, group, setting, switch

if TYPE_CHECKING:
    from snowsplat.pipeline.render import Split

_OF_VIDEOS = ("seconds", "fps", "ease", "size", "side_by_side", "video")


@dataclass(frozen=True, kw_only=True)
class Render(JsonCommand):
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

    scene: SceneChoice = group(SceneChoice)
    split: Literal["all", "test", "train"] = flag(
        "all", "test: the held-out photos; train: the training photos; all: both."
    )
    skip_train: bool = switch("The same as --split test.")
    skip_test: bool = switch("The same as --split train.")
    depth: Literal["none", "16bit", "color"] = flag(
        "none",
        "Also write the depth, to depth/00000.png … 16bit: grey values, whose unit is written to "
        "world_units_per_step.json; color: colours from yellow (near) to violet (far). With "
        "--path, color writes a second video.",
    )
    options: VideoOptions = group(VideoOptions)
    video: Path | None = setting(
        None,
        "File to which the video is written.",
        "in OUT/videos",
        metavar="FILE.mp4",
        aliases=("--film",),
    )

    def run(self) -> dict[str, Any]:
        if "path" in self.given:
            return self._render_video()
        around = self.options.projection == "equirectangular"
        for name in _OF_VIDEOS:
            if name in self.given and not (around and name == "size"):
                raise UserError("`{name}` is for videos; add a camera path with --path", name=name)
        splits: list[Split] = []
        if self.split != "train" and not self.skip_test:
            splits.append("test")
        if self.split != "test" and not self.skip_train:
            splits.append("train")
        from snowsplat.pipeline.render import render_images, render_panoramas

        antialias = self.options.antialias
        if around:
            if self.depth != "none":
                raise UserError("--projection equirectangular has no depth; leave out --depth")
            rendered = render_panoramas(
                self.scene.load(), splits=splits, size=self.options.size, antialias=antialias
            )
        else:
            rendered = render_images(
                self.scene.load(), splits=splits, depth=self.depth, antialias=antialias
            )
        for folder, count in rendered.items():
            print_message("{folder}: {count} images", folder=folder, count=count)
        print(next_step(message("for a video"), "render", self.scene.path(), "--path", "ellipse"))
        return {"images": rendered}

    def _render_video(self) -> dict[str, Any]:
        if self.depth == "16bit":
            raise UserError("--depth 16bit is for images; a video takes --depth color")
        output, model_path = self.scene.output, self.scene.model_path
        scene, target = output or model_path, self.video
        if target is None and model_path and model_path.suffix.lower() == ".mp4":
            scene, target = output, model_path  # -o FILE.mp4 can mean nothing else
        elif output is not None and model_path is not None:
            scene = None
        if scene is None:
            raise UserError("render needs one output folder of a training run, or one scene file")
        from snowsplat.pipeline.videos import render_video

        with TerminalObserver() as observer:
            videos = render_video(
                scene,
                replace(self.options, depth=self.depth == "color"),
                target=target,
                iteration=self.scene.iteration,
                compute=self.scene.compute,
                observer=observer,
            )
        print(see_and_share(scene))
        return {"videos": videos}
