"""`snowsplat render`: pictures of a scene from the cameras of its photos."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from snowsplat.cli.flags import flag, switch
from snowsplat.cli.scene import SceneFlags
from snowsplat.errors import UserError

if TYPE_CHECKING:
    import numpy as np

    from snowsplat.capture import View
    from snowsplat.gaussians import Gaussians


@dataclass
class Render(SceneFlags):
    """Render a scene from the cameras of its photos, beside the photos.

    Examples:
      snowsplat render out/garden
      snowsplat render out/garden --split test --depth color

    The pictures are OUT/test/ours_N/renders/00000.png …, the photos gt/00000.png …, in the order
    of the photos' names; OUT/train/ours_N alike.
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
    tells, or coloured from near (yellow) to far (violet)."""

    def run(self) -> int:
        """Gives the exit code, 0."""
        iteration, gaussians, capture, background = self.load()
        chosen = {
            "test": [] if self.split == "train" or self.skip_test else capture.test,
            "train": [] if self.split == "test" or self.skip_train else capture.train,
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

    def _render(
        self,
        gaussians: Gaussians,
        views: list[View],
        background: tuple[float, float, float],
        target: Path,
    ) -> None:
        import torch

        from snowsplat.capture import ImageLoader
        from snowsplat.cli import pictures
        from snowsplat.files import write_json
        from snowsplat.render import render

        color = torch.tensor(background)
        with_depth = self.depth != "none"

        def depth_of(view: View) -> np.ndarray:
            output = render(gaussians, view.camera, color, with_depth=True)
            assert output.depth is not None
            return pictures.mean_depth(output.depth, output.alpha)

        for name in ("renders", "gt", *(["depth"] if with_depth else [])):
            (target / name).mkdir(parents=True, exist_ok=True)
        steps: dict[str, float] = {}
        with PngQueue() as queue, ImageLoader(views) as loader, torch.no_grad():
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
        from snowsplat.cli.pictures import write_png

        self._under_way.append(self._pool.submit(write_png, path, pixels))
        if len(self._under_way) > 8:
            self._under_way.popleft().result()
