"""`convert`: merge and edit scenes, and write the result in another format.

`Decimation` makes fewer Gaussians that look like the whole scene.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from snowsplat.data import Dataset
from snowsplat.formats import Format
from snowsplat.formats.lod import LEVELS
from snowsplat.formats.origin_file import announce_place, origin_file, read_place, write_place
from snowsplat.formats.spz import WRITTEN_VERSIONS
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.options.scene import Edits, file_size, gaussians_to_keep
from snowsplat.pipeline.output.scene_files import (
    format_for_writing,
    read_gaussians,
    write_gaussians,
    write_levels,
)
from snowsplat.pipeline.output.scene_source import cameras_of, photos_of, viewable
from snowsplat.pipeline.true_scale import KnownDistance, compared
from snowsplat.project.project import Project
from snowsplat.scene import edit
from snowsplat.scene.camera import Camera
from snowsplat.scene.edit import seen_from_dataset
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity, rotation_from_quat
from snowsplat.scene.origin import Origin
from snowsplat.scene.simplify import simplify
from snowsplat.training.core.distillation import MERGED_RATES, distill
from snowsplat.training.core.trainer import Progress, Trainer
from snowsplat.training.settings.recipes import recipe
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.errors import SettingError
from snowsplat.util.files import check_target, make_parent, new_entries
from snowsplat.util.messages import Message, message
from snowsplat.viewer.web.panel import Description, made_on
from snowsplat.viewer.web.publication import write_html

logger = logging.getLogger(__name__)
# Steps of the distillation. See docs/what-was-tried.md.
_STEPS = 60
# See docs/what-was-tried.md.
_REFINED_STEPS = 600
# In so many steps, the means may move farther than in those of `distill`.
_REFINED_RATES = replace(
    MERGED_RATES, means=1.44e-4, means_final=4.8e-6, anneal=0.1, anneal_from=0.7
)


def convert(
    sources: Path | str | Sequence[Path | str],
    target: Path | str,
    edits: Edits | None = None,
    *,
    dataset: Path | str | None = None,
    spz_version: int | None = None,
    georeferenced: bool = False,
    known: KnownDistance | None = None,
    overwrite: bool = False,
    observer: Observer = SILENT,
) -> Format:
    """Merge scenes, edit the result, and write it to ``target``.

    Args:
        sources: scene files of any format, or output folders, whose last scene is used.
        target: the file to write, in a folder that is created if it does not exist; its suffix
            selects the format. FOLDER/lod-meta.json stands for levels of detail in this folder.
        edits: changes to the merged scene; default: none.
        dataset: with ``decimate``: train the result for a moment on the photos of this dataset.
        spz_version: the version of an .spz file, 2 to 4; default: 3.
        georeferenced: write positions in the world instead of relative to the origin of a scene
            that is far away from 0, see `scene.origin`.
        known: scale the scene about the origin, so that a unit is a metre; instead of
            ``edits.scale``.
        overwrite: replace ``target``.

    Returns:
        The format that was written.

    Raises:
        UserError: a missing or damaged scene, an unknown format, ``target`` exists, or
            ``spz_version`` is no version, or given for another format; ``georeferenced`` and a
            format without doubles; a distance that cannot be measured.
        OSError: ``target`` cannot be written.
    """
    target, edits = Path(target), edits or Edits()
    check_target(target, overwrite)
    format = format_for_writing(target)
    if spz_version is not None and format.name != "SPZ":
        raise SettingError(
            "spz_version",
            "is for .spz files, and {name} is {name2}",
            name=target.name,
            name2=format.name,
        )
    if spz_version is not None and spz_version not in WRITTEN_VERSIONS:
        raise SettingError(
            "spz_version", "{spz_version} cannot be written; use 2, 3 or 4", spz_version=spz_version
        )
    if georeferenced and format.name not in ("PLY", "glTF"):
        raise SettingError(
            "georeferenced", "{name} files have no doubles; write .ply or .glb", name=format.name
        )
    size = file_size(edits.decimate)
    if format.name == LEVELS and size is not None:
        raise SettingError("decimate", "a size is that of one file; use a number or a share")
    given = [sources] if isinstance(sources, Path | str) else sources
    projects = [Project.open(source) for source in given]
    files = [project.scene_file() for project in projects]
    if known is not None and edits.scale != 1:
        raise SettingError("scale", "is determined by `scale_to`; leave one of them out")
    metres = known and known.metres_per_unit(projects[0])
    edits = replace(edits, scale=metres) if metres else edits
    decimation = _decimation(edits, projects, dataset, observer)
    with observer.waiting("reading"):
        parts = [read_gaussians(file) for file in files]
    if len({part.antialiased for part in parts}) > 1:
        logger.warning(
            "%s: only some of the scenes are antialiased; all are marked as the first one", target
        )
    if len({any(part.origin) for part in parts}) > 1:
        logger.warning(
            "%s: some of the scenes have an origin far away from 0, others have none; do they have "
            "the same frame?",
            target,
        )
    if len({part.metres_per_unit for part in parts}) > 1:
        logger.warning(
            "%s: the scenes have different units or unknown ones; the true scale is that of the "
            "first one",
            target,
        )
    scene = _reduced(edits, edit.merge(parts))
    if metres:
        observer.note(compared(metres, scene.metres_per_unit))
        scene = replace(scene, metres_per_unit=metres)
    write: Callable[[Path, Gaussians], None] = write_gaussians
    if spz_version is not None:
        write = partial(write_gaussians, version=spz_version)
    if georeferenced and format.name == "PLY":  # glTF files always have the place in the world
        write = partial(write_gaussians, georeferenced=True)
    if format.name == "HTML" and len(files) == 1 and transform_of(edits) is None:
        write = partial(_write_page, project=projects[0])
    if format.name == LEVELS:
        write = partial(write_levels, observer=observer)

    written: list[Gaussians] = []
    make_parent(target)

    def write_placed(path: Path, gaussians: Gaussians) -> None:
        # The scene is moved last: cameras and photos show it in its place.
        with observer.waiting("writing"):
            change = transform_of(edits)
            written[:] = [edit.transform_world(gaussians, change) if change else gaussians]
            write(path, *written)

    if size is not None:
        write_within(size, target, scene, write_placed, decimation)
    elif edits.decimate is not None:
        smaller = decimation.merged(scene, gaussians_to_keep(edits.decimate, len(scene)))
        write_placed(target, decimation.fitted(smaller, scene))
    else:
        write_placed(target, scene)
    if any(written[0].origin) and format.name != "glTF" and not georeferenced:
        x, y, z = (f"{value:.15g}" for value in written[0].origin)
        observer.inform(
            "positions are relative to the origin {x} {y} {z}, {noted}",
            x=x,
            y=y,
            z=z,
            noted=_noted(format, target),
        )
    if georeferenced and not any(written[0].origin):
        observer.inform("the scene has no origin; its positions are written as they are")
    return format


def _noted(format: Format, target: Path) -> Message:
    """Where the origin of a written scene is stored."""
    if format.read is None:
        return message("which the file cannot store")
    if format.stores_origin:
        return message("which is noted in the file")
    return message("see {file}", file=origin_file(target))


def _decimation(
    edits: Edits, scenes: Sequence[Project], dataset: Path | str | None, observer: Observer
) -> Decimation:
    """The decimation, with the cameras or photos that are known for these scene files.

    Raises: UserError: the photos of ``dataset`` do not show the edited scene.
    """
    if dataset is None:
        if len(scenes) != 1:  # the cameras of one of several scenes do not show the others
            return Decimation(observer=observer)
        training = scenes[0].training
        if training is None:
            return Decimation(observer=observer)
        known = cameras_of(training)[1], training.background(), training.origin()
        return Decimation(*known, observer=observer)
    if edits.decimate is None:
        raise SettingError("refine", "is for decimated scenes; set `decimate` as well")
    if edits.crop:
        raise SettingError("refine", "the photos show the whole scene; crop it later")
    photos, background = photos_of(scenes[0].training, Path(dataset))
    refined = partial(refine, dataset=photos, background=background, observer=observer)
    cameras = [view.camera for view in photos.train]
    return Decimation(cameras, origin=photos.origin, refined=refined)


def _write_page(target: Path, scene: Gaussians, project: Project) -> None:
    """Write an HTML page, with the cameras and the background of its training if they are known."""
    shown, about = viewable(project, scene), Description(target.stem)
    about = replace(about, made=made_on(project.scene_file()))
    write_html(target, shown.ready(), about)


def _reduced(edits: Edits, scene: Gaussians) -> Gaussians:
    """The part of the scene in the box, with the SH degree; ``scene`` is unchanged.

    Raises:
        UserError: no Gaussian is in the box.
    """
    if edits.crop:
        before = len(scene)
        scene = edit.crop(scene, torch.tensor(edits.crop).reshape(2, 3))
        if before and not len(scene):
            raise SettingError("crop", "no Gaussian is in this box; see snowsplat info")
    if edits.sh_degree is not None:
        scene = edit.with_sh_degree(scene, edits.sh_degree)
    return scene


def transform_of(edits: Edits) -> Similarity | None:
    """Rotation, scale and translation of edits as one transform; None: no change."""
    if not any(edits.rotate) and edits.scale == 1 and not any(edits.translate):
        return None
    rotation = torch.eye(3, dtype=torch.float64)
    for axis, degrees in enumerate(edits.rotate):
        half = math.radians(degrees) / 2
        quat = torch.zeros(4, dtype=torch.float64)
        quat[0], quat[1 + axis] = math.cos(half), math.sin(half)
        rotation = rotation_from_quat(quat) @ rotation
    return Similarity(edits.scale, rotation, torch.tensor(edits.translate, dtype=torch.float64))


@dataclass(frozen=True)
class Decimation:
    """Makes fewer Gaussians of a scene: merges neighbours, and fits the result to views."""

    cameras: Sequence[Camera] = ()  # the cameras of the photos; empty: unknown
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # the colour behind the scene
    origin: Origin | None = None  # that of the cameras; None: that of the scene
    # Trains the result on the photos; None: it is trained on renderings of the whole scene from the
    # cameras.
    refined: Callable[[Gaussians], Gaussians] | None = None
    observer: Observer = SILENT

    def merged(self, scene: Gaussians, count: int) -> Gaussians:
        """``count`` Gaussians, see `simplify`; fewer if the scene has fewer."""
        with self.observer.waiting("merging"):
            return simplify(seen_from_dataset(scene, self.origin), count, self.cameras)

    def fitted(self, smaller: Gaussians, scene: Gaussians) -> Gaussians:
        """Merged Gaussians that look more like ``scene``, of which they were made."""
        if not 0 < len(smaller) < len(scene):
            return smaller
        if self.refined:
            return self.refined(smaller)
        return self._distilled(smaller, scene) if self.cameras else smaller

    def _distilled(self, smaller: Gaussians, scene: Gaussians) -> Gaussians:
        def report(step: int, loss: float) -> None:
            self.observer.step(Progress(step, loss, len(smaller), _STEPS, downscale=1))

        with self.observer.stepping(0, _STEPS):
            whole = seen_from_dataset(scene, self.origin).select(scene.usable_rows())
            color = torch.tensor(self.background)
            return distill(smaller, whole, self.cameras, color, _STEPS, report)


def write_within(
    size: int,
    target: Path,
    scene: Gaussians,
    write: Callable[[Path, Gaussians], None],
    decimation: Decimation,
) -> None:
    """Write ``scene`` with so many Gaussians that the file ``target`` has at most ``size`` bytes.

    Raises: SettingError: even one Gaussian needs more.
    """
    count = len(scene)
    with new_entries(target.parent, [target.name]) as new:
        path = new / target.name
        # Fitting may change the size a little, and it takes longer than merging.
        for fit in (False, True):
            while count:
                smaller = decimation.merged(scene, count)
                write(path, decimation.fitted(smaller, scene) if fit else smaller)
                actual = path.stat().st_size
                if actual <= size:
                    break
                count = int(count * min(0.98, size / actual))
        if not count:
            raise SettingError(
                "decimate", "no scene fits into {size}; use more", size=format_bytes(size)
            )
        place = read_place(path)
        announce_place(target, place, path.stat())
    write_place(target, place)


def refine(
    gaussians: Gaussians, dataset: Dataset, background: str = "black", observer: Observer = SILENT
) -> Gaussians:
    """The Gaussians after a short training on the photos, which does not change their number."""
    config = recipe(
        "default",
        iterations=_REFINED_STEPS,
        background=background,
        sh_degree=gaussians.sh_degree,
        sh_interval=0,
        coarse_to_fine=(0, 0),
        densify_until=0,
        decay_opacity=0.0,
        decay_scale=0.0,
        relative_scale=0.0,
        near_limit=0.0,
        max_gaussians=max(1, len(gaussians)),
        antialias=gaussians.antialiased,
    )
    trainer = Trainer(
        dataset, replace(config, learning_rates=_REFINED_RATES), initial=gaussians.clone()
    )
    with observer.stepping(0, _REFINED_STEPS):
        trainer.run(observer.step)
    return trainer.gaussians.detach()
