"""Fewer Gaussians: how many `convert` keeps, and what makes them look like the whole scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from snowsplat.data import Dataset
from snowsplat.formats.origin_file import read_place, write_place
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.scene.camera import Camera
from snowsplat.scene.edit import seen_from_dataset
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.origin import Origin
from snowsplat.scene.simplify import simplify
from snowsplat.training.core.distillation import MERGED_RATES, distill
from snowsplat.training.core.progress import Progress
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.settings.recipes import recipe
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.errors import SettingError
from snowsplat.util.files import new_entries

# Steps of the distillation. See docs/what-was-tried.md.
_STEPS = 60

# See docs/what-was-tried.md.
_REFINED_STEPS = 600
# In so many steps, the means may move farther than in those of `distill`.
_REFINED_RATES = replace(
    MERGED_RATES, means=1.44e-4, means_final=4.8e-6, anneal=0.1, anneal_from=0.7
)


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
