"""One training run of `recipes.py`, in a process of its own.

The request is a JSON file: {"dataset", "resolution", "hold_out", "recipe", "settings", "seed",
"milestones", "pictures"}. The result is printed as JSON on standard output.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from train import milestones

from snowsplat import Dataset, Trainer, UserError, load_dataset, ops, recipe
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.scene.render import project, render, to_8bit
from snowsplat.training.core.view_queue import FIXED_BACKGROUNDS
from snowsplat.training.settings.stored import config_to_json

#: Share of the views that `sector` holds out.
SECTOR = 1 / 8


def sector(dataset: Dataset) -> list[str]:
    """The views at one end of the scene: those whose cameras are farthest along the principal
    direction of all camera centres. Their side of the scene is left out of the training."""
    views = sorted([*dataset.train, *dataset.test], key=lambda view: view.name)
    centres = torch.stack([view.camera.position for view in views]).double()
    centres -= centres.mean(dim=0)
    direction = torch.linalg.svd(centres, full_matrices=False).Vh[0]
    # The sign of a singular vector is arbitrary: the largest component is made positive.
    direction = direction * direction[direction.abs().argmax()].sign()
    order = (centres @ direction).argsort(descending=True)
    count = max(1, round(SECTOR * len(views)))
    return sorted(views[i].name for i in order[:count].tolist())


def load(request: dict[str, Any]) -> Dataset:
    """The dataset with the hold-out of the request."""
    path, resolution = request["dataset"], request["resolution"]
    if request["hold_out"] == "eighth":
        return load_dataset(path, resolution=resolution)
    everything = load_dataset(path, resolution=resolution, hold_out=None)
    return load_dataset(path, resolution=resolution, test_list=sector(everything))


@torch.no_grad()
def pairs_per_pixel(trainer: Trainer) -> float:
    """The mean number of splats that are blended in a pixel of a test view."""
    counts = []
    for view in trainer.dataset.test:
        camera = view.camera
        splats = project(trainer.gaussians, camera)
        counts.append(float(ops.count_blended(splats, camera.width, camera.height).mean()))
    return sum(counts) / len(counts)


def train(request: dict[str, Any]) -> dict[str, Any]:
    """Train and evaluate; the clock is stopped while test views are evaluated."""
    dataset = load(request)
    if not dataset.test:
        raise UserError(f"{request['dataset']}: too few photos to hold one out")
    config = recipe(request["recipe"], **request["settings"], seed=request["seed"])
    curve, processor = [], 0.0
    begin = time.process_time()
    trainer = Trainer(dataset, config)
    iterations = trainer.schedule.iterations
    for step in milestones(iterations, request["milestones"]):
        trainer.run(until=step)
        processor += time.process_time() - begin
        found = trainer.evaluate()
        curve.append(
            {
                "steps": trainer.step,
                "seconds": processor,
                "psnr": found.psnr,
                "ssim": found.ssim,
                "gaussians": len(trainer.gaussians),
            }
        )
        begin = time.process_time()
    if request["pictures"]:
        save_pictures(trainer, Path(request["pictures"]))
    return {
        **curve[-1],
        "pairs": pairs_per_pixel(trainer),
        "train": len(dataset.train),
        "curve": curve,
        "views": found.as_json()["views"],
        "config": config_to_json(trainer.config),
    }


@torch.no_grad()
def save_pictures(trainer: Trainer, folder: Path) -> None:
    """The test views as INDEX.png, and their photos as INDEX-photo.png."""
    folder.mkdir(parents=True, exist_ok=True)
    background = torch.tensor(FIXED_BACKGROUNDS.get(trainer.config.background, (0.0, 0.0, 0.0)))
    views = trainer.dataset.test
    with ImageLoader(views) as loader:
        for i, view in enumerate(views):
            image = render(trainer.gaussians, view.camera, background).image
            for name, each in ((f"{i}", image), (f"{i}-photo", loader.get(view).over(background))):
                Image.fromarray(to_8bit(each)).save(folder / f"{name}.png")


def main() -> None:
    request = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    ops.set_num_threads(1)
    print(json.dumps(train(request)))


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        sys.exit(str(error))
