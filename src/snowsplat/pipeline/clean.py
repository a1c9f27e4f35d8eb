"""`clean`: a scene without floaters."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from snowsplat.data import Dataset
from snowsplat.evaluation.floaters import clean as without_floaters
from snowsplat.evaluation.metrics import compare, evaluate_views, size_text
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.output.scene_files import format_for_writing, write_gaussians
from snowsplat.pipeline.output.scene_source import load_viewable, photos_of
from snowsplat.project.project import Project
from snowsplat.project.training_folder import Color
from snowsplat.scene.camera import Camera
from snowsplat.scene.edit import seen_from_dataset
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render
from snowsplat.util.errors import UserError
from snowsplat.util.files import check_target, make_parent
from snowsplat.util.process import single_threaded

_VIEWS = 24  # at most so many photos are compared, evenly chosen
#: The PSNR of the training photos may fall by this number of dB, and that of the renderings of the
#: whole scene to the second number: the difference is not visible.
_LOST, _SAME = 0.02, 40.0
_SAME_IMAGE = 100.0  # the PSNR of identical renderings

_Item = TypeVar("_Item")


@dataclass(frozen=True)
class Cleaned:
    """What `clean` has done."""

    before: int  # number of Gaussians
    after: int  # number of Gaussians
    compared: str  # what was compared with the renderings, such as "7 held-out photos"
    psnr: tuple[float, float]  # of the renderings in dB, before and after


def clean(
    scene: Path | str,
    target: Path | str,
    *,
    dataset: Path | str | None = None,
    overwrite: bool = False,
    compute: Compute | None = None,
    observer: Observer = SILENT,
) -> Cleaned:
    """Remove Gaussians that hang in front of the surfaces, and those that no photo shows.

    Floaters are removed as long as the PSNR of the held-out photos does not decrease. If no photos
    were held out, that of the training photos is used; without photos, the renderings of the whole
    scene take their place.

    Args:
        scene: the output folder of a training run, or a scene file.
        target: the file to write, in a folder that is created if it does not exist; its suffix
            selects the format.
        dataset: the photos of the scene; default: the photos of the training, if they still exist.
        overwrite: replace ``target``.
        compute: the device; default: a GPU if there is one.
        observer: gets the stages "reading" and "cleaning".

    Raises:
        UserError: a missing or damaged scene or dataset; the cameras are unknown; ``target``
            exists, or has an unknown suffix.
        OSError: ``target`` cannot be written.
    """
    scene, target = Path(scene), Path(target)
    check_target(target, overwrite)
    format_for_writing(target)
    device = (compute or Compute()).apply()
    with observer.waiting("reading"):
        project = Project.open(scene)
        source = load_viewable(project)
        photos = _photos(project, None if dataset is None else Path(dataset))
    gaussians, cameras = source.gaussians, source.cameras
    if photos is not None:
        gaussians = seen_from_dataset(gaussians, photos.origin)
        cameras = [view.camera for view in [*photos.train, *photos.test]]
    if not cameras:
        raise UserError(
            "{scene}: the cameras are unknown, because it is in no output folder; set `dataset`, "
            "or edit it in snowsplat studio",
            scene=scene,
        )
    gaussians = gaussians.to(device)
    cameras = [camera.to(device) for camera in cameras]
    with observer.waiting("cleaning") as report, single_threaded():
        judge = _judge(gaussians, cameras, photos, source.background)
        before = judge.psnr(gaussians)
        cleaned = without_floaters(gaussians, cameras, judge.psnr, judge.enough(before), report)
        after = judge.psnr(cleaned)
    make_parent(target)
    write_gaussians(target, cleaned.to(torch.device("cpu")))
    return Cleaned(len(gaussians), len(cleaned), judge.compared, (before, after))


@dataclass(frozen=True)
class _Judge:
    """Decides whether Gaussians may be removed: see `floaters.clean`."""

    compared: str
    psnr: Callable[[Gaussians], float]
    enough: Callable[[float], float]


def _judge(
    gaussians: Gaussians, cameras: Sequence[Camera], photos: Dataset | None, background: Color
) -> _Judge:
    if photos is None:
        return _judge_of_renderings(gaussians, cameras, background)
    views = _evenly(photos.test or photos.train)

    def psnr(scene: Gaussians) -> float:
        return evaluate_views(scene, views, background=background).psnr

    size = size_text((view.camera.width, view.camera.height) for view in views)
    if photos.test:
        return _Judge(f"{len(views)} held-out photos of {size}", psnr, lambda before: math.inf)
    return _Judge(f"{len(views)} training photos of {size}", psnr, lambda before: before - _LOST)


def _judge_of_renderings(
    gaussians: Gaussians, cameras: Sequence[Camera], background: Color
) -> _Judge:
    color = torch.tensor(background, device=gaussians.means.device)
    chosen = _evenly(cameras)

    def images(scene: Gaussians) -> list[Tensor]:
        return [render(scene, camera, color).image.clamp(0.0, 1.0) for camera in chosen]

    whole = images(gaussians)

    def psnr(scene: Gaussians) -> float:
        pairs = zip(images(scene), whole, strict=True)
        return sum(min(compare(a, b).psnr, _SAME_IMAGE) for a, b in pairs) / len(whole)

    return _Judge(f"renderings of {len(chosen)} cameras", psnr, lambda before: _SAME)


def _photos(project: Project, dataset: Path | None) -> Dataset | None:
    """The photos of a scene; None: they are unknown, or not there any more. Raises UserError."""
    if dataset is None:
        if project.training is None or not project.training.scenes():
            return None
        dataset = Path(project.training.settings()[0].path)
        if not dataset.is_dir():
            return None
    photos = photos_of(project.training, dataset)[0]
    if project.has_seen_all_photos:
        return replace(photos, train=[*photos.train, *photos.test], test=[])
    return photos


def _evenly(items: Sequence[_Item]) -> Sequence[_Item]:
    return items[:: math.ceil(len(items) / _VIEWS)]
