"""A training run with the density control of the paper, recorded for the figures.

The run has the demo's photos at half of their size. Its schedule is shortened: 4000 steps,
densification from step 500 to 2500, and an opacity reset every 1000 steps. The record is stored in
build/learn/run.pt, and made if it is missing (some minutes).
"""

import functools
from dataclasses import replace
from typing import Any

import torch

import scene
from snowsplat import Gaussians
from snowsplat.data.load import load_dataset
from snowsplat.training.core.trainer import Progress, Trainer
from snowsplat.training.parts.densification import Densification
from snowsplat.training.settings.recipes import recipe

STEPS = 4000
SNAPSHOTS = (0, 200, 500, 600, 1000, 1010, 1500, 2500, 4000)


def _trainer() -> Trainer:
    config = recipe(
        "paper",
        iterations=STEPS,
        densify_until=2500,
        opacity_reset_interval=1000,
        sh_interval=500,
        lr_means_steps=STEPS,
        test_iterations=tuple(range(100, STEPS + 1, 100)),
    )
    # The limit of the size in the world is for scenes that are larger than the camera path.
    config = replace(config, density=replace(config.density, prune_world_size=0.0))
    return Trainer(load_dataset(scene.dataset_folder(), resolution=2), config)


@functools.cache
def record() -> dict[str, Any]:
    """loss, count and psnr by step; events by densification; scenes: parameters by step."""
    path = scene.BUILD / "run.pt"
    if not path.exists():
        trainer = _trainer()
        found: dict[str, Any] = {"loss": [], "count": [], "psnr": {}, "events": {}, "scenes": {}}
        found["scenes"][0] = {k: v.clone() for k, v in trainer.gaussians.parameters().items()}

        def after(progress: Progress) -> None:
            found["loss"].append(progress.loss)
            found["count"].append(progress.gaussians)
            if progress.metrics is not None:
                found["psnr"][progress.step] = progress.metrics.psnr
            if progress.step in SNAPSHOTS:
                parameters = trainer.gaussians.parameters().items()
                found["scenes"][progress.step] = {k: v.clone() for k, v in parameters}
            density: Any = trainer.part(Densification).control
            settings = density.settings
            densifies = density.first <= progress.step <= density.last
            if densifies and progress.step % settings.densify_interval == 0:
                # The next step begins with this densification; see `AdaptiveControl._refine`.
                grads = density.grad_sum / density.views.clamp_min(1.0)
                size = trainer.gaussians.log_scales.amax(dim=1).exp() / density.extent
                alive = trainer.gaussians.opacities >= settings.prune_opacity
                dense = alive & (grads > settings.grad_threshold)
                large = size > settings.percent_dense
                found["events"][progress.step] = {
                    "clones": int((dense & ~large).sum()),
                    "splits": int((dense & large).sum()),
                    "prunes": int((~alive).sum()),
                    "grads": grads.clone() if progress.step in SNAPSHOTS else None,
                }

        trainer.run(after)
        torch.save(found, path)
    return torch.load(path)


def snapshot(step: int) -> Gaussians:
    """The Gaussians after a step of `SNAPSHOTS`."""
    return Gaussians(**record()["scenes"][step])


if __name__ == "__main__":
    print(record()["events"])
