"""`render_images`: renders a scene from the cameras of its photos, and copies the photos.

`evaluate` measures PSNR, SSIM and LPIPS of a trained scene.
"""

import errno
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from snowsplat.data import ImageLoader, View
from snowsplat.evaluation.lpips import Lpips
from snowsplat.evaluation.metrics import Evaluation, ViewMetrics, evaluate_views, renderings
from snowsplat.pipeline.options.video import panorama_width
from snowsplat.pipeline.output import image_files
from snowsplat.pipeline.output.scene_source import TrainedScene
from snowsplat.pipeline.videos import level_cameras
from snowsplat.project.training_folder import RenderedFolder
from snowsplat.scene.camera import Camera
from snowsplat.scene.panorama import PanoramaRenderer
from snowsplat.scene.render import render, to_8bit
from snowsplat.util.errors import UserError
from snowsplat.util.files import new_entries, write_json
from snowsplat.util.process import single_threaded

logger = logging.getLogger(__name__)

Depth = Literal["none", "16bit", "color"]

_RANGE_VIEWS = 8  # number of views that determine the range of the depth colours
Split = Literal["test", "train"]


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
        UserError: there are no views in these splits, or at least half of the photos are damaged.
        OSError: an image cannot be written.
    """
    scene, chosen = _chosen(scene, splits, antialias)
    rendered = {}
    for split, of_split in chosen.items():
        target = scene.folder.rendered(split, scene.iteration)
        _render(scene, of_split, target, depth)
        rendered[target.renders] = len(of_split)
    return rendered


def render_panoramas(
    scene: TrainedScene,
    *,
    splits: Sequence[Split] = ("test", "train"),
    size: str | None = None,
    antialias: bool | None = None,
) -> dict[Path, int]:
    """Render all directions from the places of the photos into OUT/SPLIT/ours_N/panoramas.

    The files 00000.jpg … are equirectangular, and their metadata say so (GPano). Their horizon is
    level and their centre is in the direction of the photo. Photos from one place have one picture;
    for the views of a panorama, its centre is that of the panorama.

    Args:
        size: the width, twice the height, in pixels, e.g. "3840"; default: 3840.
        antialias: as in `render_images`.

    Returns: The folders and the number of images in each.

    Raises:
        UserError: there are no views in these splits, or the size is not possible.
        OSError: an image cannot be written.
    """
    scene, chosen = _chosen(scene, splits, antialias)
    device = scene.gaussians.means.device
    renderer = PanoramaRenderer(panorama_width(size), device)
    color = torch.tensor(scene.background, device=device)
    rendered = {}
    for split, views in chosen.items():
        folder = scene.folder.rendered(split, scene.iteration).panoramas
        folder.parent.mkdir(parents=True, exist_ok=True)
        places: list[Camera] = []
        for view, camera in zip(views, level_cameras([v.camera for v in views]), strict=True):
            same = (i for i, p in enumerate(places) if torch.allclose(camera.position, p.position))
            i = next(same, len(places))
            if i == len(places) or Path(view.name).stem.endswith("_front"):  # see `lens_views`
                places[i : i + 1] = [camera]
        with new_entries(folder.parent, [folder.name]) as new, torch.no_grad():
            (new / folder.name).mkdir()
            for i, camera in enumerate(places):
                image = renderer.render(scene.gaussians, camera.cam_from_world, color)
                image_files.write_panorama(new / folder.name / f"{i:05d}.jpg", to_8bit(image))
        rendered[folder] = len(places)
    return rendered


def _chosen(
    scene: TrainedScene, splits: Sequence[Split], antialias: bool | None
) -> tuple[TrainedScene, dict[Split, Sequence[View]]]:
    """The scene with the mark ``antialias`` if given, and the views of the splits that have any."""
    views = {"test": scene.dataset.test, "train": scene.dataset.train}
    chosen: dict[Split, Sequence[View]] = {s: views[s] for s in splits if views[s]}
    if not chosen:
        raise UserError(
            "no views to render: no photos were held out for testing; use the `split` train"
        )
    if antialias is not None:
        scene = replace(scene, gaussians=replace(scene.gaussians, antialiased=antialias))
    return scene, chosen


def _render(
    scene: TrainedScene, views: Sequence[View], target: RenderedFolder, depth: Depth
) -> None:
    gaussians = scene.gaussians
    device = gaussians.means.device
    color = torch.tensor(scene.background, device=device)
    with_depth = depth != "none"

    @torch.no_grad()
    def depth_of(camera: Camera) -> np.ndarray:
        output = render(gaussians, camera, color, with_depth=True)
        assert output.depth is not None
        return image_files.mean_depth(output.depth, output.alpha)

    target.path.mkdir(parents=True, exist_ok=True)
    folders = [target.photos, *([target.depth] if with_depth else []), target.renders]
    steps: dict[str, float] = {}
    with (
        new_entries(target.path, [folder.name for folder in folders]) as new,
        ImageLoader(views, device=device) as loader,
        image_files.PngQueue() as queue,
    ):
        target = RenderedFolder(new)
        for folder in folders:
            (new / folder.name).mkdir()
        if depth == "color":  # one range for all images, from a sample of them
            sample = views[:: -(-len(views) // _RANGE_VIEWS)]
            near, far = image_files.depth_range([depth_of(view.camera) for view in sample])
        draw = partial(render, with_depth=with_depth)
        drawn = renderings(gaussians, views, loader, color, render=draw, leave_out=True)
        numbers = {view.name: i for i, view in enumerate(views)}
        for each in drawn:
            file, output = f"{numbers[each.view.name]:05d}.png", each.output
            queue.write(target.renders / file, to_8bit(each.image))
            queue.write(target.photos / file, to_8bit(each.photo))
            if output.depth is None:
                continue
            mean = image_files.mean_depth(output.depth, output.alpha)
            if depth == "color":
                shown = image_files.depth_in_color(mean, near, far)
            else:
                shown, steps[file] = image_files.depth_in_16_bits(mean)
            queue.write(target.depth / file, shown)
        if steps:
            write_json(target.depth_units, steps)


def evaluate(
    scene: TrainedScene,
    *,
    split: Split = "test",
    lpips: Lpips | Path | str | None = None,
    on_view: Callable[[ViewMetrics], None] | None = None,
) -> Evaluation:
    """Compare the renderings of a scene with its photos; write OUT/metrics.json, if possible.

        evaluate(load_trained("out/garden")).psnr

    Args:
        split: "test": the held-out photos; "train": the training photos.
        lpips: a file of weights, see `snowsplat.evaluation.lpips`; None: LPIPS is not measured.
        on_view: called after each view.

    Returns:
        PSNR, SSIM and LPIPS of each view, and their means.

    Raises:
        UserError: there are no photos in this split, or a photo or the weights file is damaged.
        OSError: metrics.json cannot be written, for another reason than a folder or disk in which
            nothing can be written.
    """
    views = views_of(scene, split)
    if isinstance(lpips, Path | str):
        lpips = Lpips.load(Path(lpips))
    with single_threaded():  # so that the metrics do not depend on the number of cores
        evaluation = evaluate_views(
            scene.gaussians, views, background=scene.background, lpips=lpips, on_view=on_view
        )
    try:
        scene.folder.write_metrics(scene.iteration, split, evaluation.as_json())
    except OSError as error:  # the folder may be of somebody else; the figures are returned
        if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC):
            raise
        logger.warning("metrics.json was not written: %s", error)
    return evaluation


def views_of(scene: TrainedScene, split: Split) -> list[View]:
    """The views of a split. Raises: UserError: there are none."""
    views = scene.dataset.test if split == "test" else scene.dataset.train
    if not views:
        raise UserError(
            "no photos were held out for testing; train with `hold_out`, or evaluate the `split` "
            "train"
        )
    return views
