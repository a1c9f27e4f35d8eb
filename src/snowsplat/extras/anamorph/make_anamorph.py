"""`make_anamorph`: Gaussians that show another picture from each side."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from snowsplat.data import read_dataset
from snowsplat.evaluation.metrics import Evaluation, compare
from snowsplat.extras.anamorph.arrangement import AROUND, FIELD, arranged, camera_around, camera_of
from snowsplat.extras.anamorph.options import AnamorphOptions
from snowsplat.extras.image.fit_image import load_photo
from snowsplat.extras.pictures import write_pictures
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.output.scene_source import load_viewable
from snowsplat.pipeline.run.training_files import write_beginning, write_scene
from snowsplat.project.training_folder import DatasetSettings, TrainingFolder
from snowsplat.scene.render import render
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.settings.recipes import recipe
from snowsplat.util.errors import UserError
from snowsplat.viewer.web.panel import Description
from snowsplat.viewer.web.publication import write_html

#: The folder of the dataset that `make_anamorph` writes: the pictures and their cameras.
PICTURES = "pictures"
PAGE = "anamorph.html"
#: The photos of the dataset, in the order of the sides, and around them.
NAMES = ["front", "right", "top", *(f"around_{number}" for number in range(len(AROUND)))]
# Rates with which only the colours change: a solid stays where it is, and opaque.
_COLORS_ONLY = {"lr_means": 1e-7, "lr_means_final": 1e-7, "lr_quats": 1e-6}
_COLORS_ONLY |= {"lr_log_scales": 1e-6, "lr_opacity_logits": 1e-6}
_LARGEST = 4096  # pixels along the longer side of a picture that is decoded


@dataclass(frozen=True)
class AnamorphResult:
    """An anamorph."""

    scene: Path  # the PLY file
    page: Path  # the HTML file
    gaussians: int
    psnr: list[float]  # of each picture, seen from its side, in dB


def make_anamorph(
    pictures: Sequence[Path | str],
    output: Path | str,
    options: AnamorphOptions | None = None,
    *,
    threads: int | None = None,
    overwrite: bool = False,
    observer: Observer = SILENT,
) -> AnamorphResult:
    """Make a scene that shows one picture from the front, one from the right, one from above.

    It writes an output folder as `train` does, with a dataset of the pictures, and a page. The
    colours do not depend on the direction. The computation runs on the CPU.

    Args:
        pictures: two or three image files, of which the square in the middle is used.
        output: the output folder. It is created if it does not exist.
        threads: number of CPU threads; None: all cores. The result does not depend on it.
        overwrite: replace an earlier scene in ``output``.

    Raises:
        UserError: another number of pictures; one is missing or damaged; ``output`` contains other
            files.
        OSError: a file cannot be written.
        KeyboardInterrupt: Ctrl-C; the folder then contains no scene.
    """
    options, out = options or AnamorphOptions(), TrainingFolder(Path(output))
    if len(pictures) not in (2, 3):
        raise UserError("an anamorph has two or three pictures, not {count}", count=len(pictures))
    out.check_free(resume=False, overwrite=overwrite)
    squares = [_square(Path(picture), options.size) for picture in pictures]
    if options.shape == "solid" and len(squares) == 2:  # a plain top
        squares.append(torch.stack(squares).mean((0, 1, 2)).expand_as(squares[0]))
    Compute("cpu", threads).apply()
    cameras = [camera_of(side, round(FIELD * options.size)) for side in range(len(squares))]
    photos = [_photo(square, camera.width) for square, camera in zip(squares, cameras, strict=True)]
    settings = DatasetSettings(str((out.path / PICTURES).absolute()))
    write_pictures(out.path / PICTURES, NAMES, photos, cameras)
    dataset = read_dataset(settings)
    config = recipe(
        "classic",
        iterations=max(options.steps, 1),
        sh_degree=0,
        antialias=True,
        coarse_to_fine=(0.0, 0.0),
        densify_until=0,
        prune_opacity=0.0,
        seed=options.seed,
        **(_COLORS_ONLY if options.shape == "solid" else {}),
    )
    out.remove_results()
    write_beginning(out, dataset, settings, config)
    first = arranged(squares, options.cells, options.shape, options.seed)
    trainer = Trainer(dataset, config, initial=first)
    with observer.stepping(0, options.steps):
        trainer.run(observer.step, until=options.steps)
    scene = write_scene(out, options.steps, trainer.gaussians)
    if options.shape == "solid":  # a mesh needs photos of the back, too
        cameras += [camera_around(direction, cameras[0].width) for direction in AROUND]
    with torch.no_grad():
        seen = [render(trainer.gaussians, camera).image for camera in cameras]
    write_pictures(out.path / PICTURES, NAMES, [*photos, *seen[len(photos) :]], cameras)
    metrics = [
        compare(image, photo, name=name)
        for image, photo, name in zip(seen, photos, NAMES, strict=False)
    ]
    out.write_metrics(options.steps, "train", Evaluation(metrics).as_json())
    write_html(out.path / PAGE, load_viewable(out.path).ready(), Description(out.path.name))
    return AnamorphResult(scene, out.path / PAGE, len(trainer.gaussians), [m.psnr for m in metrics])


def _square(path: Path, size: int) -> Tensor:
    """The square in the middle of a picture, (S, S, 3) in 0..1, with S of at most ``size``."""
    photo = load_photo(path, _LARGEST)
    side = min(photo.shape[:2])
    top, left = ((length - side) // 2 for length in photo.shape[:2])
    planes = photo[top : top + side, left : left + side].permute(2, 0, 1)[None]
    planes = interpolate(planes, (size, size), mode="bicubic", antialias=True)
    return planes[0].permute(1, 2, 0).clamp(0, 1)


def _photo(picture: Tensor, width: int) -> Tensor:
    """The picture with a black border, (width, width, 3)."""
    before = (width - len(picture)) // 2
    after = width - len(picture) - before
    return pad(picture, (0, 0, before, after, before, after))
