"""The setting `sky`: PSNR, and fog before the surfaces, on a procedural street under a sky.

    python benchmarks/sky.py --out OUT
    python benchmarks/sky.py --out OUT --seeds 0 1 2

The photos are ray traced (`benchmarks/street.py`); every 8th is held out. Each seed is
trained with and without it. Fog is measured along the street, with cameras that no photo has: the
opacity of the Gaussians that are clearly nearer than the surface that the ray tracer finds there.
OUT also gets pictures (photo, without, with) and films. Results are kept; the same command resumes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from blocks import walk, write_film, write_pictures
from torch import Tensor
from torch.nn.functional import max_pool2d

from snowsplat.data import ImageLoader
from snowsplat.evaluation.metrics import psnr
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.output.scene_source import TrainedScene, load_trained
from snowsplat.pipeline.render import evaluate
from snowsplat.pipeline.train import train
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render
from snowsplat.synthetic.scene import Scene

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from street import street
from street_dataset import DATASET_FROM_SCENE, write_street_dataset
from tests.scenes.depth import distances

#: A Gaussian is before a surface if its depth is less than this share of the surface's.
BEFORE = 0.8
#: Metres: what is before the sky is fog if it is nearer than this.
NEAR = 100.0
#: Metres: a surface that is farther away is the sky.
SKY = 1000.0
#: Pixels: at the edges of the surfaces, their Gaussians reach into the sky.
EDGE = 8


def surface_distances(scene: Scene, camera: Camera) -> Tensor:
    """(H, W) distances from the camera to the surfaces, in metres."""
    y, x = np.mgrid[0.5 : camera.height, 0.5 : camera.width]
    rays = np.stack(
        [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)]
    ).reshape(3, -1)
    scene_from_dataset = DATASET_FROM_SCENE[:, :3].T.numpy()
    pose = camera.world_from_cam.numpy()
    directions = scene_from_dataset @ pose[:, :3] @ (rays / np.linalg.norm(rays, axis=0))
    origin = scene_from_dataset @ pose[:, 3:]
    found = distances(scene, origin.astype(np.float32), directions.astype(np.float32))
    return torch.from_numpy(found.reshape(camera.height, camera.width))


@torch.no_grad()
def fog(gaussians: Gaussians, camera: Camera, surface: Tensor) -> Tensor:
    """(H, W) the opacity of all Gaussians that are before the surface, rendered alone."""
    pixel, depth = camera.project(gaussians.means)
    size = torch.tensor([camera.width, camera.height])
    inside = (depth > 0.0) & (pixel >= 0.0).all(1) & (pixel < size).all(1)
    x, y = torch.where(inside[:, None], pixel, 0.0).long().unbind(1)
    distance = (gaussians.means - camera.position.to(gaussians.means.dtype)).norm(dim=1)
    before = inside & (distance < (BEFORE * surface[y, x]).clamp(max=NEAR))
    return render(gaussians.select(before), camera).alpha


def sky_psnr(scene: TrainedScene, traced: Scene) -> float:
    """The mean PSNR of the pixels of the held-out photos that show the sky."""
    values = []
    with ImageLoader(scene.dataset.test) as loader, torch.no_grad():
        for view in scene.dataset.test:
            sky = surface_distances(traced, view.camera) > SKY
            if sky.float().mean() > 0.05:
                photo = loader.get(view).rgb.to(torch.float32)[sky] / 255.0
                values.append(psnr(render(scene.gaussians, view.camera).image[sky], photo))
    return float(np.mean(values))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for all results")
    parser.add_argument("--photos", type=int, default=96)
    parser.add_argument("--size", type=int, nargs=2, default=(240, 160), metavar=("W", "H"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--frames", type=int, default=120, help="of the film, and for the fog")
    options = parser.parse_args()

    dataset = options.out / "street"
    write_street_dataset(dataset, options.photos, *options.size)
    print("| seed | sky | PSNR | PSNR of the sky | fog | fog before the sky | worst |")
    print("|---|---|---|---|---|---|---|")
    for seed in options.seeds:
        scenes = {}
        for name in ("without", "with"):
            out = options.out / f"{name}_{seed}"
            if not (out / "metrics.json").is_file():
                settings: dict[str, Any] = {"seed": seed, "sky": name == "with"}
                train(dataset, out, TrainOptions(settings=settings, hold_out=8), overwrite=True)
            scenes[name] = scene = load_trained(out)
            traced = street(0.16 * options.photos, 0)
            camera = scene.dataset.test[0].camera
            length = max(float(view.camera.position[0]) for view in scene.dataset.train)
            parts, skies = [], []
            for each in walk(length, camera, options.frames // 10):
                surface = surface_distances(traced, each)
                alpha = fog(scene.gaussians, each, surface)
                parts.append(float(alpha.mean()))
                edge = 2 * EDGE + 1
                nearest = -max_pool2d(-surface[None], edge, stride=1, padding=EDGE)[0]
                if (nearest > SKY).any():
                    skies.append(float(alpha[nearest > SKY].mean()))
            print(
                f"| {seed} | {name} | {evaluate(scene).psnr:.2f} dB "
                f"| {sky_psnr(scene, traced):.2f} dB "
                f"| {100 * np.mean(parts):.2f}% | {100 * np.mean(skies):.2f}% "
                f"| {100 * max(skies):.2f}% |",
                flush=True,
            )
        views = scenes["with"].dataset.test[:6]
        write_pictures(options.out / f"{seed}.png", views, scenes["without"], scenes["with"])
        write_film(options.out / f"{seed}.mp4", scenes["without"], scenes["with"], options.frames)


if __name__ == "__main__":
    main()
