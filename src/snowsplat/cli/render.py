"""`snowsplat render`: pictures of a scene from the cameras of its photos, and films of it."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from snowsplat.cli.flags import flag, switch
from snowsplat.cli.scene import SceneFlags
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    import numpy as np

    from snowsplat.data import View
    from snowsplat.scene.camera import Camera
    from snowsplat.scene.gaussians import Gaussians


@dataclass
class Render(SceneFlags):
    """Render a scene from the cameras of its photos, beside the photos; or a film of it.

    Examples:
      snowsplat render out/garden
      snowsplat render out/garden --split test --depth color
      snowsplat render out/garden --path ellipse
      snowsplat render out/garden --path training --seconds 20 --size 1920x1080
      snowsplat render out/garden --path keys.json --side-by-side
      snowsplat render garden.ply --path ellipse --film garden.mp4

    The pictures are OUT/test/ours_N/renders/00000.png …, the photos gt/00000.png …, in the order
    of the photos' names; OUT/train/ours_N alike. Films are OUT/films/ellipse.mp4 …; a scene's file
    is enough for those around it (ellipse) and along a list of cameras.
    """

    split: Annotated[Literal["all", "test", "train"], flag("{all,test,train}", default="all")] = (
        "all"
    )
    """The photos held out, those trained on, or both."""
    skip_train: Annotated[bool, switch()] = False
    """The same as --split test."""
    skip_test: Annotated[bool, switch()] = False
    """The same as --split train."""
    depth: Annotated[
        Literal["none", "16bit", "color"], flag("{none,16bit,color}", default="none")
    ] = "none"
    """Depth too, as depth/00000.png: 16 bits of grey, whose steps world_units_per_step.json
    tells, or coloured from near (yellow) to far (violet). Of a film: another one, in colour."""

    path: Annotated[str | None, flag("{training,ellipse,spiral,FILE}", default="pictures")] = None
    """Make a film. training: along the way of the photos, smoothed; ellipse: around what they show;
    spiral: before what cameras that look one way show; or through the cameras of a FILE like
    OUT/cameras.json, which makes a loop where the last one is the first."""
    seconds: Annotated[float | None, flag("F", default="10")] = None
    """Length of the film."""
    fps: Annotated[float | None, flag("F", default="30")] = None
    """Frames a second."""
    size: Annotated[str | None, flag("WxH|W", default="that of the photos")] = None
    """Size of the film in pixels, or its width."""
    side_by_side: Annotated[bool, switch()] = False
    """Colour and depth beside each other in one film."""
    film: Annotated[Path | None, flag("FILE.mp4", default="in OUT/films")] = None
    """The film's file."""

    def run(self) -> int:
        """Gives the exit code, 0."""
        if self.path is not None:
            self._film(self.path)
            return 0
        for name in ("seconds", "fps", "size", "side_by_side", "film"):
            if getattr(self, name):
                flag_name = name.replace("_", "-")
                raise UserError(f"--{flag_name} is for films; say which by --path, as ellipse")
        iteration, gaussians, dataset, background = self.load()
        chosen = {
            "test": [] if self.split == "train" or self.skip_test else dataset.test,
            "train": [] if self.split == "test" or self.skip_train else dataset.train,
        }
        if not any(chosen.values()):
            raise UserError(
                "no views to render: no photos were held out for testing; use --split train"
            )
        for split, views in chosen.items():
            if views:
                target = self.folder().path / split / f"ours_{iteration}"
                self._render(gaussians, views, background, target)
                print(f"{target / 'renders'}: {len(views)} pictures")
        return 0

    def _film(self, way: str) -> None:
        from snowsplat.pipeline.films import Film, FilmSize, cameras_along, frames_in

        if self.depth == "16bit":
            raise UserError("--depth 16bit is for pictures; a film takes --depth color")
        out = self.model_path
        if self.film is None and out is not None and out.suffix.lower() == ".mp4":
            self.film, self.model_path = out, None  # -o FILE.mp4 can mean nothing else
        if self.film is not None and self.film.suffix.lower() != ".mp4":
            raise UserError(f"--film is {self.film}; its name must end in .mp4")
        fps = 30.0 if self.fps is None else self.fps
        frames = frames_in(10.0 if self.seconds is None else self.seconds, fps)
        size = FilmSize.parse(self.size)
        device = self.computing()
        name = way if Path(way).suffix == "" else Path(way).stem
        gaussians, trained, background, file = self._film_source(name)
        cameras = cameras_along(way, gaussians, trained, frames, size)
        depth = self.depth == "color"
        Film(
            *(gaussians.to(device), cameras, background, self.film or file, fps, depth),
            side_by_side=self.side_by_side,
        ).make()

    def _film_source(
        self, name: str
    ) -> tuple[
        Gaussians,
        tuple[list[str], list[Camera]] | None,
        tuple[float, float, float],
        Path,
    ]:
        """Scene, cameras of its training, background, and the film's file: of a folder or a file.

        The photos themselves are not needed.
        """
        from snowsplat.cli.scene import folder_around
        from snowsplat.formats import read_gaussians
        from snowsplat.scene.camera_json import read_cameras

        suffix = "_side_by_side" if self.side_by_side else ""
        scene = self.output or self.model_path
        if scene is not None and scene.is_file():
            file = scene.with_name(f"{scene.stem}_{name}{suffix}.mp4")
            folder, gaussians = folder_around(scene), read_gaussians(scene)
            if not folder.is_one():
                return gaussians, None, (0.0, 0.0, 0.0), file
        else:
            folder = self.folder()
            _, gaussians = folder.read_scene(self.iteration)
            file = folder.path / "films" / f"{name}{suffix}.mp4"
        _, background = folder.settings()
        return gaussians, read_cameras(folder.path / "cameras.json"), background, file

    def _render(
        self,
        gaussians: Gaussians,
        views: list[View],
        background: tuple[float, float, float],
        target: Path,
    ) -> None:
        import torch

        from snowsplat.data import ImageLoader
        from snowsplat.pipeline import pictures
        from snowsplat.scene.render import render
        from snowsplat.util.files import write_json

        device = gaussians.means.device
        color = torch.tensor(background, device=device)
        with_depth = self.depth != "none"

        def depth_of(view: View) -> np.ndarray:
            output = render(gaussians, view.camera, color, with_depth=True)
            assert output.depth is not None
            return pictures.mean_depth(output.depth, output.alpha)

        for name in ("renders", "gt", *(["depth"] if with_depth else [])):
            (target / name).mkdir(parents=True, exist_ok=True)
        steps: dict[str, float] = {}
        with PngQueue() as queue, ImageLoader(views, device=device) as loader, torch.no_grad():
            loader.prefetch(views)
            if self.depth == "color":  # one range for all pictures, from some of them
                some = views[:: -(-len(views) // 8)]
                near, far = pictures.depth_range([depth_of(view) for view in some])
            for i, view in enumerate(views):
                file = f"{i:05d}.png"
                output = render(gaussians, view.camera, color, with_depth=with_depth)
                queue.write(target / "renders" / file, pictures.to_8bit(output.image))
                photo = loader.get(view).over(color)
                queue.write(target / "gt" / file, pictures.to_8bit(photo))
                if output.depth is None:
                    continue
                depth = pictures.mean_depth(output.depth, output.alpha)
                if self.depth == "color":
                    shown = pictures.depth_in_color(depth, near, far)
                else:
                    shown, steps[file] = pictures.depth_in_16_bits(depth)
                queue.write(target / "depth" / file, shown)
        if steps:
            write_json(target / "depth" / "world_units_per_step.json", steps)


class PngQueue:
    """Writes pictures in the background, a few behind: PNG takes longer than rendering."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(2)
        self._under_way: deque[Future[None]] = deque()

    def __enter__(self) -> PngQueue:
        return self

    def __exit__(self, *error: object) -> None:
        with self._pool:
            if error[0] is None:
                while self._under_way:
                    self._under_way.popleft().result()

    def write(self, path: Path, pixels: np.ndarray) -> None:
        """Raises: OSError: an earlier picture could not be written."""
        from snowsplat.pipeline.pictures import write_png

        self._under_way.append(self._pool.submit(write_png, path, pixels))
        if len(self._under_way) > 8:
            self._under_way.popleft().result()
