"""A scene with fewer Gaussians, trained again for a moment on its photos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from snowsplat.data import Dataset, read_dataset
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.run.refined_cameras import with_refined
from snowsplat.project.training_folder import DatasetSettings, TrainingFolder
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.core.distillation import MERGED_RATES
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.settings.recipes import recipe

# See docs/what-was-tried.md.
_STEPS = 600
# In so many steps, the means may move farther than in those of `distill`.
_RATES = replace(MERGED_RATES, means=1.44e-4, means_final=4.8e-6, anneal=0.1, anneal_from=0.7)


def photos_of(training: TrainingFolder | None, dataset: Path) -> tuple[Dataset, str]:
    """The photos for `refine`, and the colour behind them.

    If the training of the scene is known, the photos have the size of its training, those that it
    held out are held out, and the cameras are those that it has refined.
    Raises: UserError: ``dataset`` is not a dataset.
    """
    settings = DatasetSettings(str(dataset.absolute()))
    if training is None or not training.scenes():
        return read_dataset(settings), "black"
    trained, color = training.settings()
    photos = read_dataset(replace(trained, path=settings.path))
    return with_refined(training, photos), "white" if min(color) == 1.0 else "black"


def refine(
    gaussians: Gaussians, dataset: Dataset, background: str = "black", observer: Observer = SILENT
) -> Gaussians:
    """The Gaussians after a short training on the photos, which does not change their number."""
    config = recipe(
        "default",
        iterations=_STEPS,
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
    trainer = Trainer(dataset, replace(config, learning_rates=_RATES), initial=gaussians.clone())
    with observer.stepping(0, _STEPS):
        trainer.run(observer.step)
    return trainer.gaussians.detach()
