"""`render_images`: renders a scene from the cameras of its photos, and copies the photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from snowsplat.data import ImageLoader, View
from snowsplat.pipeline.evaluate import Split
from snowsplat.pipeline.output import image_files
from snowsplat.pipeline.output.scene_source import TrainedScene
from snowsplat.scene.camera import Camera
from snowsplat.scene.render import render
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_json

Depth = Literal["none", "16bit", "color"]

_RANGE_VIEWS = 8  # number of views that determine the range of the depth colours


def render_images(
    scene: TrainedScene,
    *,
    splits: Sequence[Split] = ("test", "train"),
    depth: Depth = "none",
    antialias: bool | None = None,
) -> dict[Path, int]:
    """Render the views of a scene into OUT/SPLIT/ours_N, where N is the number of steps.

    Files are numbered in the order of the names of the photos: renders/00000.png, the photo
    gt/00000.png, and depth/00000.png. The depth is the mean camera z. It is written either as
    16-bit grey values, whose unit in world units is in depth/world_units_per_step.json, or in
    colours from near to far.

    Args:
        antialias: whether to render with the 2D mip filter, see `Gaussians`; default: as trained.

    Returns:
        The folders renders/ and the number of images in each.

    Raises:
        UserError: there are no views in these splits, or a photo is damaged.
        OSError: an image cannot be written.
    """
    views = {"test": scene.dataset.test, "train": scene.dataset.train}
    chosen = {split: views[split] for split in splits if views[split]}
    if not chosen:
        raise UserError(
            "no views to render: no photos were held out for testing; use the `split` train"
        )
    if antialias is not None:
        scene = replace(scene, gaussians=replace(scene.gaussians, antialiased=antialias))
    rendered = {}
    for split, of_split in chosen.items():
        target = scene.folder.path / split / f"ours_{scene.iteration}"
        _render(scene, of_split, target, depth)
        rendered[target / "renders"] = len(of_split)
    return rendered


def _render(scene: TrainedScene, views: Sequence[View], target: Path, depth: Depth) -> None:
    gaussians = scene.gaussians
    device = gaussians.means.device
    color = torch.tensor(scene.background, device=device)
    with_depth = depth != "none"

    def depth_of(camera: Camera) -> np.ndarray:
        output = render(gaussians, camera, color, with_depth=True)
        assert output.depth is not None
        return image_files.mean_depth(output.depth, output.alpha)

    for name in ("renders", "gt", *(["depth"] if with_depth else [])):
        (target / name).mkdir(parents=True, exist_ok=True)
    steps: dict[str, float] = {}
    with (
        image_files.PngQueue() as queue,
        ImageLoader(views, device=device) as loader,
        torch.no_grad(),
    ):
        loader.prefetch(views)
        if depth == "color":  # one range for all images, from a sample of them
            sample = views[:: -(-len(views) // _RANGE_VIEWS)]
            near, far = image_files.depth_range([depth_of(view.camera) for view in sample])
        for i, view in enumerate(views):
            file = f"{i:05d}.png"
            output = render(gaussians, view.camera, color, with_depth=with_depth)
            queue.write(target / "renders" / file, image_files.to_8bit(output.image))
            photo = loader.get(view).over(color)
            queue.write(target / "gt" / file, image_files.to_8bit(photo))
            if output.depth is None:
                continue
            mean = image_files.mean_depth(output.depth, output.alpha)
            if depth == "color":
                shown = image_files.depth_in_color(mean, near, far)
            else:
                shown, steps[file] = image_files.depth_in_16_bits(mean)
            queue.write(target / "depth" / file, shown)
    if steps:
        write_json(target / "depth" / "world_units_per_step.json", steps)
